"""Miners against their definitions, worked out one pair or triplet after the other."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from pytorch_metric_learning import miners
from torch.utils._python_dispatch import TorchDispatchMode

from lab.training.losses import MINERS, AngularMiner, batch_accuracy, make_loss, make_miner
from shared.descriptors.aggregators.base import normalise_rows
from shared.errors import Unprocessable
from tests.lab.unit.training.test_losses import (
    LABELS,
    NEGATIVES,
    POSITIVES,
    ROWS,
    TRIPLETS,
    D,
    N,
    S,
    X,
    Y,
)

pytestmark = pytest.mark.numerics


def mine(name: str, margin: float = 0.1) -> list[Any]:
    miner = make_miner(name, margin)
    assert miner is not None
    found: list[Any] = [part.tolist() for part in miner(ROWS, LABELS)]
    return found


def pairs(anchors: list[int], others: list[int]) -> list[tuple[int, int]]:
    return list(zip(anchors, others, strict=True))


@pytest.mark.parametrize("margin", [0.1, 0.4])
def test_multi_similarity_keeps_pairs_within_the_margin_of_the_hardest(margin: float) -> None:
    """Wang et al. 2019, eq. 11 and 12."""
    hardest = {i: max(S[i, n] for a, n in NEGATIVES if a == i) for i in range(N)}
    farthest = {i: min(S[i, p] for a, p in POSITIVES if a == i) for i in range(N)}
    near = {(a, p) for a, p in POSITIVES if S[a, p] - margin < hardest[a]}
    far = {(a, n) for a, n in NEGATIVES if S[a, n] + margin > farthest[a]}
    assert 0 < len(near) < len(POSITIVES)
    assert 0 < len(far) < len(NEGATIVES)
    a1, p, a2, n = mine("MultiSimilarityMiner", margin)
    assert sorted(pairs(a1, p)) == sorted(near)
    assert sorted(pairs(a2, n)) == sorted(far)


def angle(a: int, p: int, n: int) -> float:
    """Degrees; Wang et al. 2017, eq. 3 and 4."""
    radius = math.dist(X[a], X[p]) / 2
    return math.degrees(math.atan(radius / math.dist(X[n], (X[a] + X[p]) / 2)))


def test_angular_keeps_triplets_with_a_wide_angle_at_the_negative() -> None:
    expected = [triplet for triplet in TRIPLETS if angle(*triplet) > 20]
    assert 0 < len(expected) < len(TRIPLETS)
    assert list(zip(*mine("AngularMiner"), strict=True)) == expected


@pytest.mark.parametrize("numbers_at_once", [1, 100, 1 << 22])
@pytest.mark.parametrize("degrees", [10, 20, 35])
def test_angular_finds_the_librarys_triplets_in_its_order_however_small_its_steps(
    degrees: float, numbers_at_once: int
) -> None:
    rows = normalise_rows(torch.randn(48, 16, generator=torch.Generator().manual_seed(0)))
    labels = torch.tensor([0, 1, 2, 3, 4, 5] * 8)
    expected = miners.AngularMiner(angle=degrees)(rows, labels)
    found = AngularMiner(degrees, numbers_at_once)(rows, labels)
    assert len(expected[0])
    for ours, theirs in zip(found, expected, strict=True):
        assert torch.equal(ours, theirs)


class Largest(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """How many numbers the largest tensor of floats has that is made meanwhile."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.numbers = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        if isinstance(out, torch.Tensor) and out.is_floating_point():
            self.numbers = max(self.numbers, out.numel())
        return out


def test_memory_of_the_angular_miner_does_not_grow_with_its_triplets() -> None:
    rows = torch.randn(48, 128, generator=torch.Generator().manual_seed(0))
    labels = torch.arange(12).repeat_interleave(4)  # 48 x 3 x 44 triplets
    bound = 10_000
    with Largest() as ours:
        AngularMiner(20, bound)(rows, labels)
    with Largest() as theirs:
        miners.AngularMiner(20)(rows, labels)
    assert ours.numbers <= bound
    assert theirs.numbers == 48 * 3 * 44 * 128


def nearest(i: int, candidates: list[tuple[int, int]], beyond: float = -1.0) -> int:
    """The photo nearest to i, of the pairs of i, and farther than `beyond`."""
    return min((D[i, j], j) for a, j in candidates if a == i and D[i, j] > beyond)[1]


def test_batch_hard_takes_each_photos_farthest_positive_and_nearest_negative() -> None:
    a, p, n = mine("BatchHardMiner")
    assert a == list(range(N))
    assert p == [max((D[i, j], j) for b, j in POSITIVES if b == i)[1] for i in range(N)]
    assert n == [nearest(i, NEGATIVES) for i in range(N)]


def test_batch_easy_hard_takes_the_nearest_positive_and_the_nearest_negative_beyond_it() -> None:
    a1, p, a2, n = mine("BatchEasyHardMiner")
    assert a1 == a2
    assert a1 == [
        i
        for i in range(N)
        if max(D[a, n] for a, n in NEGATIVES if a == i)
        > min(D[a, p] for a, p in POSITIVES if a == i)
    ]
    assert p == [nearest(i, POSITIVES) for i in a1]
    assert n == [nearest(i, NEGATIVES, D[i, near]) for i, near in zip(a1, p, strict=True)]


@pytest.mark.parametrize("margin", [0.1, 0.3])
def test_triplet_margin_keeps_semihard_triplets(margin: float) -> None:
    """Schroff et al. 2015, eq. 4: the negative is farther than the positive, but not by more than
    the margin."""
    expected = [(a, p, n) for a, p, n in TRIPLETS if 0 < D[a, n] - D[a, p] <= margin]
    assert 0 < len(expected) < len(TRIPLETS)
    assert list(zip(*mine("TripletMarginMiner", margin), strict=True)) == expected


def test_pair_margin_keeps_positives_below_and_negatives_above_a_cosine() -> None:
    a1, p, a2, n = mine("PairMarginMiner")
    near = [pair for pair in POSITIVES if S[pair] < 0.7]
    far = [pair for pair in NEGATIVES if S[pair] > 0.3]
    assert 0 < len(near) < len(POSITIVES)
    assert 0 < len(far) < len(NEGATIVES)
    assert pairs(a1, p) == near
    assert pairs(a2, n) == far


def test_uniform_histogram_draws_ten_pairs_of_each_distance_that_occurs() -> None:
    torch.manual_seed(0)
    a1, p, a2, n = mine("UniformHistogramMiner")
    for found, known in ((pairs(a1, p), POSITIVES), (pairs(a2, n), NEGATIVES)):
        assert set(found) <= set(known)
        distances = np.array([D[pair] for pair in known])

        def bins(values: Any, low: float = distances.min(), high: float = distances.max()) -> Any:
            return np.minimum(((values - low) / (high - low) * 100).astype(int), 99)

        drawn = np.bincount(bins(np.array([D[pair] for pair in found])), minlength=100)
        there = np.bincount(bins(distances), minlength=100) > 0
        # A distance on the edge of two bins may be counted in the one or the other.
        assert np.abs(drawn - 10 * there).sum() <= 40
        assert len(found) == pytest.approx(10 * there.sum(), abs=20)


def test_the_margin_reaches_two_miners_alone() -> None:
    reached = set()
    for name in MINERS:
        torch.manual_seed(0)
        first = mine(name, 0.1)
        torch.manual_seed(0)
        if mine(name, 0.3) != first:
            reached.add(name)
    assert reached == {"MultiSimilarityMiner", "TripletMarginMiner"}


@pytest.mark.parametrize("name", MINERS)
def test_a_batch_with_one_photo_of_each_place_yields_no_positive(name: str) -> None:
    miner = make_miner(name)
    assert miner is not None
    found = miner(ROWS, torch.arange(N))
    assert len(found[0]) == len(found[1]) == 0


def test_names_are_read_in_any_case_and_unknown_ones_list_the_known() -> None:
    assert make_miner(None) is None
    assert make_miner("None") is None
    assert isinstance(make_miner("batchhard"), miners.BatchHardMiner)
    with pytest.raises(Unprocessable, match=r"MultiSimilarityMiner, .*, none") as refused:
        make_miner("MultiSimilarityMinner")
    assert refused.value.code == "unknown_miner"


def test_batch_accuracy_is_the_share_of_photos_that_are_no_anchor() -> None:
    loss, miner = make_loss("MultiSimilarityLoss"), make_miner("TripletMarginMiner")
    mined = (torch.tensor([0, 0, 4, 9]), torch.tensor([1, 2, 5, 10]), torch.tensor([3, 3, 0, 0]))
    assert batch_accuracy(loss, miner, mined, 15) == pytest.approx(1 - 3 / 15)
    assert batch_accuracy(loss, None, None, 15) is None
    assert batch_accuracy(make_loss("FastAPLoss"), miner, mined, 15) is None
    assert batch_accuracy(loss, make_miner("UniformHistogramMiner"), mined, 15) is None


def test_the_batch_of_these_tests_is_one_of_places() -> None:
    assert sorted(Y.tolist()) == Y.tolist()
    assert len(POSITIVES) + len(NEGATIVES) == N * (N - 1)
