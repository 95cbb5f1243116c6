"""Losses against their published formulas, worked out in numpy, one pair after the other."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from pytorch_metric_learning import losses

from lab.training.losses import LOSSES, MINERS, AngularLoss, NTXentLoss, make_loss, make_miner
from shared.errors import Unprocessable

pytestmark = pytest.mark.numerics

Rows = NDArray[np.float64]
Pairs = list[tuple[int, int]]
Triplets = list[tuple[int, int, int]]


def batch(places: int = 5, photos: int = 3, width: int = 8) -> tuple[torch.Tensor, torch.Tensor]:
    """Unit rows, near to those of their place, and their labels."""
    rng = np.random.default_rng(4)
    rows = rng.standard_normal((places, 1, width)) + 0.8 * rng.standard_normal(
        (places, photos, width)
    )
    rows /= np.linalg.norm(rows, axis=-1, keepdims=True)
    labels = torch.arange(places).repeat_interleave(photos)
    return torch.from_numpy(rows.reshape(-1, width).astype(np.float32)), labels


ROWS, LABELS = batch()
X, Y = ROWS.double().numpy(), LABELS.numpy()
N = len(X)
S = X @ X.T
D = np.array([[math.sqrt(math.fsum((a - b) ** 2)) for b in X] for a in X])
POSITIVES: Pairs = [(i, j) for i in range(N) for j in range(N) if i != j and Y[i] == Y[j]]
NEGATIVES: Pairs = [(i, j) for i in range(N) for j in range(N) if Y[i] != Y[j]]
TRIPLETS: Triplets = [(a, p, n) for a, p in POSITIVES for b, n in NEGATIVES if a == b]

SOME_TRIPLETS = TRIPLETS[::7] + TRIPLETS[:20:2]  # some more than once
SOME = tuple(torch.tensor(part) for part in zip(*SOME_TRIPLETS, strict=True))
SOME_POSITIVES: Pairs = [(a, p) for a, p, _ in SOME_TRIPLETS]
SOME_NEGATIVES: Pairs = [(a, n) for a, _, n in SOME_TRIPLETS]


def mean(values: list[float]) -> float:
    return math.fsum(values) / len(values)


def mean_of_nonzero(values: list[float]) -> float:
    return mean([value for value in values if value > 0])


def multi_similarity(positives: Pairs, negatives: Pairs) -> float:
    """Wang et al. 2019, eq. 15, with alpha 1, beta 50 and lambda 0."""
    total = []
    for i in range(N):
        near = math.fsum(math.exp(-S[pair]) for pair in set(positives) if pair[0] == i)
        far = math.fsum(math.exp(50 * S[pair]) for pair in set(negatives) if pair[0] == i)
        total.append(math.log(1 + near) + math.log(1 + far) / 50)
    return mean(total)


def angular(positives: Pairs, negatives: Pairs) -> float:
    """Wang et al. 2017, eq. 8, at 40 degrees; the negatives are all of the batch."""
    del negatives
    square = math.tan(math.radians(40)) ** 2
    total = []
    for a, p in positives:
        exponents = [
            4 * square * float((X[a] + X[p]) @ X[n]) - 2 * (1 + square) * S[a, p]
            for n in range(N)
            if Y[n] != Y[a]
        ]
        total.append(math.log(1 + math.fsum(math.exp(value) for value in exponents)))
    return mean(total)


def triplet_margin(triplets: Triplets) -> float:
    return mean_of_nonzero([max(0.0, D[a, p] - D[a, n] + 0.1) for a, p, n in triplets])


def ntxent(positives: Pairs, negatives: Pairs) -> float:
    """Chen et al. 2020, eq. 1, at a temperature of 0.07."""
    total = []
    for a, p in positives:
        near = math.exp(S[a, p] / 0.07)
        far = math.fsum(math.exp(S[pair] / 0.07) for pair in negatives if pair[0] == a)
        total.append(-math.log(near / (near + far)))
    return mean(total)


def fast_ap(weights: Rows) -> float:
    """Cakir et al. 2019, eq. 5 to 8: squared distances, binned linearly in 30 steps of [0, 4]."""
    edges, step = np.linspace(0, 4, 31), 4 / 30
    total = []
    for i in range(N):
        near, far = np.zeros(31), np.zeros(31)
        for j in range(N):
            share = np.maximum(0, 1 - np.abs(D[i, j] ** 2 - edges) / step)
            if j != i:
                (near if Y[j] == Y[i] else far)[:] += share
        both = np.cumsum(near + far)
        some = both > 0
        precision = (near * np.cumsum(near))[some] / both[some]
        total.append(weights[i] * (1 - precision.sum() / near.sum()))
    return mean(total)


def supcon() -> float:
    """Khosla et al. 2020, eq. 2, at a temperature of 0.07."""
    total = []
    for i in range(N):
        all_others = math.fsum(math.exp(S[i, j] / 0.07) for j in range(N) if j != i)
        near = [S[i, j] / 0.07 - math.log(all_others) for a, j in POSITIVES if a == i]
        total.append(-mean(near))
    return mean_of_nonzero(total)


def circle() -> float:
    """Sun et al. 2020, eq. 6 and 8, with m 0.4 and gamma 80."""
    total = []
    for i in range(N):
        near = math.fsum(
            math.exp(-80 * max(0.0, 1.4 - S[pair]) * (S[pair] - 0.6))
            for pair in POSITIVES
            if pair[0] == i
        )
        far = math.fsum(
            math.exp(80 * max(0.0, S[pair] + 0.4) * (S[pair] - 0.4))
            for pair in NEGATIVES
            if pair[0] == i
        )
        total.append(math.log(1 + near * far))
    return mean_of_nonzero(total)


def contrastive() -> float:
    """Hadsell, Chopra and LeCun 2006, of distances, not of their squares; margins 0 and 1."""
    near = mean_of_nonzero([D[pair] for pair in POSITIVES])
    return near + mean_of_nonzero([max(0.0, 1 - D[pair]) for pair in NEGATIVES])


@pytest.mark.parametrize(
    ("name", "formula"),
    [
        ("MultiSimilarityLoss", lambda: multi_similarity(POSITIVES, NEGATIVES)),
        ("AngularLoss", lambda: angular(POSITIVES, NEGATIVES)),
        ("TripletMarginLoss", lambda: triplet_margin(TRIPLETS)),
        ("FastAPLoss", lambda: fast_ap(np.ones(N))),
        ("NTXentLoss", lambda: ntxent(POSITIVES, NEGATIVES)),
        ("SupConLoss", supcon),
        ("CircleLoss", circle),
        ("ContrastiveLoss", contrastive),
    ],
)
def test_a_loss_equals_its_formula_on_all_pairs(name: str, formula: Callable[[], float]) -> None:
    assert float(make_loss(name)(ROWS, LABELS, None)) == pytest.approx(formula(), rel=1e-5)


@pytest.mark.parametrize(
    ("name", "formula"),
    [
        ("MultiSimilarityLoss", lambda: multi_similarity(SOME_POSITIVES, SOME_NEGATIVES)),
        ("AngularLoss", lambda: angular(SOME_POSITIVES, SOME_NEGATIVES)),
        ("TripletMarginLoss", lambda: triplet_margin(SOME_TRIPLETS)),
        ("NTXentLoss", lambda: ntxent(SOME_POSITIVES, SOME_NEGATIVES)),
    ],
)
def test_a_loss_learns_from_the_mined_triplets_alone(
    name: str, formula: Callable[[], float]
) -> None:
    found = float(make_loss(name)(ROWS, LABELS, SOME))
    assert found == pytest.approx(formula(), rel=1e-5)
    assert found != pytest.approx(float(make_loss(name)(ROWS, LABELS, None)), rel=1e-3)


def test_fastap_takes_mined_triplets_as_weights_of_photos() -> None:
    """How often a photo comes in them, the most frequent one counting 1."""
    counts = np.bincount(np.array(SOME_TRIPLETS).ravel(), minlength=N)
    found = float(make_loss("FastAPLoss")(ROWS, LABELS, SOME))
    assert found == pytest.approx(fast_ap(counts / counts.max()), rel=1e-5)


@pytest.mark.parametrize("miner", [*MINERS, None])
@pytest.mark.parametrize(
    ("ours", "theirs"),
    [
        (AngularLoss(alpha=40), losses.AngularLoss(alpha=40)),
        (NTXentLoss(temperature=0.07), losses.NTXentLoss(temperature=0.07)),
    ],
    ids=["angular", "ntxent"],
)
def test_what_is_summed_otherwise_is_the_librarys_loss_and_gradient(
    ours: torch.nn.Module, theirs: torch.nn.Module, miner: str | None
) -> None:
    torch.manual_seed(0)
    mining = make_miner(miner)
    mined = None if mining is None else mining(ROWS, LABELS)
    found = []
    for loss in (ours, theirs):
        rows = ROWS.clone().requires_grad_()
        value = loss(rows, LABELS, mined)
        value.backward()
        assert rows.grad is not None
        found.append((float(value.detach()), rows.grad))
    assert found[0][0] == pytest.approx(found[1][0], rel=1e-5)
    np.testing.assert_allclose(found[0][1], found[1][1], atol=1e-5)


def test_an_anchor_without_negatives_costs_nothing_and_has_a_finite_gradient() -> None:
    rows = ROWS.clone().requires_grad_()
    pairs = tuple(torch.tensor(part) for part in ([0, 3], [1, 4], [0, 0], [5, 6]))
    loss = make_loss("NTXentLoss")(rows, LABELS, pairs)
    far = math.exp(S[0, 5] / 0.07) + math.exp(S[0, 6] / 0.07)
    near = math.exp(S[0, 1] / 0.07)
    expected = -math.log(near / (near + far)) / 2
    assert float(loss.detach()) == pytest.approx(expected, rel=1e-5)
    loss.backward()
    assert rows.grad is not None
    assert bool(rows.grad.isfinite().all())


@pytest.mark.parametrize("name", LOSSES)
def test_a_batch_without_pairs_of_a_place_is_no_error(name: str) -> None:
    rows = ROWS.clone().requires_grad_()
    loss = make_loss(name)(rows, torch.arange(N), None)
    loss.backward()
    assert bool(loss.isfinite())


def test_names_are_read_in_any_case_and_unknown_ones_list_the_known() -> None:
    assert isinstance(make_loss("ntxent"), NTXentLoss)
    assert isinstance(make_loss(" ANGULARLOSS "), AngularLoss)
    with pytest.raises(Unprocessable, match="MultiSimilarityLoss, AngularLoss") as refused:
        make_loss("ArcFaceLoss")
    assert refused.value.code == "unknown_loss"
