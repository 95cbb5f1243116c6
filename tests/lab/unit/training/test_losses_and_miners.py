"""Losses and miners: published settings, and own versions that equal the library's."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from pytorch_metric_learning import losses, miners
from pytorch_metric_learning.distances import CosineSimilarity, DotProductSimilarity, LpDistance
from torch.utils._python_dispatch import TorchDispatchMode

from lab.training.losses import (
    LOSSES,
    MINERS,
    AngularLoss,
    AngularMiner,
    NTXentLoss,
    batch_accuracy,
    make_loss,
    make_miner,
)
from shared.descriptors.aggregators.base import normalise_rows
from shared.errors import Unprocessable

pytestmark = pytest.mark.numerics

PLACES, PHOTOS = 5, 3
LABELS = torch.arange(PLACES).repeat_interleave(PHOTOS)


def place_rows(width: int = 8) -> torch.Tensor:
    """Unit rows, near to those of their place."""
    rng = np.random.default_rng(4)
    rows = rng.standard_normal((PLACES, 1, width))
    rows = rows + 0.8 * rng.standard_normal((PLACES, PHOTOS, width))
    return normalise_rows(torch.from_numpy(rows.reshape(-1, width).astype(np.float32)))


ROWS = place_rows()


@pytest.mark.parametrize(
    ("name", "distance", "settings"),
    [
        ("MultiSimilarityLoss", DotProductSimilarity, {"alpha": 1.0, "beta": 50, "base": 0.0}),
        ("AngularLoss", LpDistance, {"alpha": pytest.approx(math.radians(40))}),
        (
            "TripletMarginLoss",
            LpDistance,
            {"margin": 0.1, "swap": False, "smooth_loss": False, "triplets_per_anchor": "all"},
        ),
        ("FastAPLoss", LpDistance, {"num_bins": 30}),
        ("NTXentLoss", CosineSimilarity, {"temperature": 0.07}),
        ("SupConLoss", CosineSimilarity, {"temperature": 0.07}),
        ("CircleLoss", CosineSimilarity, {"m": 0.4, "gamma": 80}),
        ("ContrastiveLoss", LpDistance, {"pos_margin": 0, "neg_margin": 1}),
    ],
)
def test_losses_have_the_settings_of_the_published_runs(
    name: str, distance: type, settings: dict[str, Any]
) -> None:
    loss: Any = make_loss(name)
    assert isinstance(loss, getattr(losses, name))
    assert type(loss.distance) is distance
    assert {key: getattr(loss, key) for key in settings} == settings


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("MultiSimilarityMiner", {"epsilon": 0.3}),
        ("UniformHistogramMiner", {"num_bins": 100, "pos_per_bin": 10, "neg_per_bin": 10}),
        ("AngularMiner", {"tangent": pytest.approx(math.tan(math.radians(20)))}),
        ("BatchHardMiner", {"pos_strategy": "hard", "neg_strategy": "hard"}),
        ("BatchEasyHardMiner", {"pos_strategy": "easy", "neg_strategy": "semihard"}),
        ("TripletMarginMiner", {"margin": 0.3, "type_of_triplets": "semihard"}),
        ("PairMarginMiner", {"pos_margin": 0.7, "neg_margin": 0.3}),
    ],
)
def test_miners_have_the_settings_of_the_published_runs_and_two_take_the_margin(
    name: str, settings: dict[str, Any]
) -> None:
    miner: Any = make_miner(name, 0.3)
    assert name == "AngularMiner" or isinstance(miner, getattr(miners, name))
    assert {key: getattr(miner, key) for key in settings} == settings


@pytest.mark.parametrize("miner", [*MINERS, None])
@pytest.mark.parametrize(
    ("own", "library"),
    [
        (AngularLoss(alpha=40), losses.AngularLoss(alpha=40)),
        (NTXentLoss(temperature=0.07), losses.NTXentLoss(temperature=0.07)),
    ],
    ids=["angular", "ntxent"],
)
def test_own_losses_equal_those_of_the_library_in_value_and_gradient(
    own: torch.nn.Module, library: torch.nn.Module, miner: str | None
) -> None:
    torch.manual_seed(0)
    mining = make_miner(miner)
    mined = None if mining is None else mining(ROWS, LABELS)
    found = []
    for loss in (own, library):
        rows = ROWS.clone().requires_grad_()
        value = loss(rows, LABELS, mined)
        value.backward()
        assert rows.grad is not None
        found.append((float(value.detach()), rows.grad))
    assert found[0][0] == pytest.approx(found[1][0], rel=1e-5)
    np.testing.assert_allclose(found[0][1], found[1][1], atol=1e-5)


def test_an_anchor_without_negatives_has_zero_loss_and_a_finite_gradient() -> None:
    rows = ROWS.clone().requires_grad_()
    pairs = tuple(torch.tensor(part) for part in ([0, 3], [1, 4], [0, 0], [5, 6]))
    loss = make_loss("NTXentLoss")(rows, LABELS, pairs)
    near, *far = (ROWS[0] @ ROWS[[1, 5, 6]].T / 0.07).exp().tolist()
    assert float(loss.detach()) == pytest.approx(-math.log(near / (near + sum(far))) / 2, rel=1e-5)
    loss.backward()
    assert rows.grad is not None
    assert bool(rows.grad.isfinite().all())


def test_a_batch_without_pairs_of_a_place_is_no_error() -> None:
    labels = torch.arange(len(ROWS))
    for name in LOSSES:
        rows = ROWS.clone().requires_grad_()
        loss = make_loss(name)(rows, labels, None)
        loss.backward()
        assert bool(loss.isfinite()), name
    for name in MINERS:
        miner = make_miner(name)
        assert miner is not None
        found = miner(ROWS, labels)
        assert len(found[0]) == len(found[1]) == 0, name


@pytest.mark.parametrize("block_values", [1, 100, 1 << 22])
@pytest.mark.parametrize("degrees", [10, 35])
def test_the_angular_miner_finds_the_librarys_triplets_in_blocks_of_any_size(
    degrees: float, block_values: int
) -> None:
    rows = normalise_rows(torch.randn(48, 16, generator=torch.Generator().manual_seed(0)))
    labels = torch.tensor([0, 1, 2, 3, 4, 5] * 8)
    expected = miners.AngularMiner(angle=degrees)(rows, labels)
    found = AngularMiner(degrees, block_values)(rows, labels)
    assert len(expected[0])
    for own, library in zip(found, expected, strict=True):
        assert torch.equal(own, library)


class LargestTensor(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Records the number of values of the largest tensor of floats that is made meanwhile."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.values = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        if isinstance(out, torch.Tensor) and out.is_floating_point():
            self.values = max(self.values, out.numel())
        return out


def test_memory_of_the_angular_miner_does_not_grow_with_its_triplets() -> None:
    rows = torch.randn(48, 128, generator=torch.Generator().manual_seed(0))
    labels = torch.arange(12).repeat_interleave(4)  # 48 x 3 x 44 triplets
    with LargestTensor() as largest:
        AngularMiner(20, 10_000)(rows, labels)
    assert largest.values <= 10_000


def test_names_are_read_in_any_case_and_unknown_ones_list_the_known() -> None:
    assert isinstance(make_loss("ntxent"), NTXentLoss)
    assert isinstance(make_loss(" ANGULARLOSS "), AngularLoss)
    assert isinstance(make_miner("batchhard"), miners.BatchHardMiner)
    assert make_miner(None) is make_miner("None") is None
    with pytest.raises(Unprocessable, match="MultiSimilarityLoss, AngularLoss") as refused:
        make_loss("ArcFaceLoss")
    assert refused.value.code == "unknown_loss"
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
