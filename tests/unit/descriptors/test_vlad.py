"""VLAD, hard and soft, against the published formula, patch by patch (Jegou et al. 2010; AnyLoc,
RA-L 2023).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch.utils._python_dispatch import TorchDispatchMode

from shared.descriptors.aggregators.clustering import assign_clusters, soft_vlad, vlad
from shared.descriptors.vocabulary_file import read_vocabulary

pytestmark = pytest.mark.numerics

Matrix = NDArray[np.float64]


def unit(rows: Matrix) -> Matrix:
    norms = np.linalg.norm(rows, axis=-1, keepdims=True)
    found: Matrix = rows / np.where(norms > 0, norms, 1)
    return found


def slow_vlad(patches: Matrix, centres: Matrix) -> Matrix:
    """One photo: (N, D) patches and (K, D) raw centres -> (K * D,), every step written out."""
    clusters, width = centres.shape
    blocks = np.zeros((clusters, width))
    for patch in patches:
        similarities = [
            sum(float(patch[d]) * float(centre[d]) for d in range(width))
            / math.sqrt(sum(float(v) ** 2 for v in centre))
            for centre in centres
        ]
        label = similarities.index(max(similarities))
        blocks[label] += patch - centres[label]
    row: Matrix = unit(unit(blocks).reshape(-1))
    return row


def some_patches(seed: int, photos: int, patches: int, width: int) -> Matrix:
    return unit(np.random.default_rng(seed).standard_normal((photos, patches, width)))


def raw_centres(seed: int, clusters: int, width: int) -> Matrix:
    """Of different lengths, all but one shorter than 1, as AnyLoc's are."""
    rng = np.random.default_rng(seed)
    lengths = np.linspace(0.3, 1.2, clusters)[:, None]
    return unit(rng.standard_normal((clusters, width))) * lengths


def tensor(array: Matrix) -> torch.Tensor:
    return torch.from_numpy(array.astype(np.float32))


@pytest.mark.parametrize(("clusters", "width", "patches"), [(1, 4, 5), (4, 8, 30), (8, 16, 50)])
def test_rows_equal_the_formula_computed_patch_by_patch(
    clusters: int, width: int, patches: int
) -> None:
    features = some_patches(clusters, 3, patches, width)
    centres = raw_centres(width, clusters, width)
    expected = np.stack([slow_vlad(photo, centres) for photo in features])
    np.testing.assert_allclose(vlad(tensor(features), tensor(centres)), expected, atol=1e-5)


def slow_soft_vlad(patches: Matrix, centres: Matrix, temperature: float) -> Matrix:
    """As `slow_vlad`: every patch in every cluster, with its residual to that cluster's centre."""
    blocks = np.zeros(centres.shape)
    for patch in patches:
        similarities = [float(patch @ centre) / np.linalg.norm(centre) for centre in centres]
        exponentials = [math.exp(temperature * similarity) for similarity in similarities]
        for k, centre in enumerate(centres):
            blocks[k] += exponentials[k] / sum(exponentials) * (patch - centre)
    row: Matrix = unit(unit(blocks).reshape(-1))
    return row


@pytest.mark.parametrize("temperature", [0.1, 1.0, 10.0])
@pytest.mark.parametrize(("clusters", "width", "patches"), [(1, 4, 5), (4, 8, 30), (8, 16, 50)])
def test_soft_rows_equal_the_formula_computed_patch_by_patch(
    clusters: int, width: int, patches: int, temperature: float
) -> None:
    features = some_patches(clusters, 3, patches, width)
    centres = raw_centres(width, clusters, width)
    expected = np.stack([slow_soft_vlad(photo, centres, temperature) for photo in features])
    found = soft_vlad(tensor(features), tensor(centres), temperature)
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_soft_blocks_hold_residuals_to_their_own_centre_alone() -> None:
    """AnyLoc's code sums the residuals to all centres into each block, weighed by its cluster."""
    patches, centres = some_patches(1, 1, 20, 8), raw_centres(2, 4, 8)
    logits = patches[0] @ unit(centres).T
    weights = np.exp(logits) / np.exp(logits).sum(axis=1, keepdims=True)
    residuals = patches[0][:, None] - centres[None]
    upstream = unit(unit(np.einsum("qk,qcd->kd", weights, residuals)).reshape(-1))
    ours = soft_vlad(tensor(patches), tensor(centres), 1.0)[0]
    assert np.abs(ours.numpy() - upstream).max() > 0.05


@pytest.mark.real_photos
@pytest.mark.parametrize("domain", ["aerial", "indoor", "urban"])
def test_anylocs_vocabularies_give_rows_of_the_published_dimension(
    real_photos: Path, domain: str
) -> None:
    folder = real_photos / "anyloc-vocabularies"
    centres = read_vocabulary(folder / f"dinov2_vitg14_l31_value_c32_{domain}.pt").centres
    # Features near the real centres, so that most clusters have some.
    rng = np.random.default_rng(3)
    near = centres.array[rng.integers(0, 32, 300)] + 0.01 * rng.standard_normal((300, 1536))
    features = unit(near.astype(np.float64))
    row = vlad(tensor(features[None]), torch.from_numpy(centres.array))[0]
    assert row.shape == (49_152,)
    expected = np.zeros((32, 1536))
    for k, patch in zip(
        (features @ unit(centres.array.astype(float)).T).argmax(1), features, strict=True
    ):
        expected[k] += patch - centres.array[k]
    np.testing.assert_allclose(row, unit(unit(expected).reshape(-1)), atol=1e-5)


def test_a_patch_is_assigned_to_the_first_of_equally_similar_centres() -> None:
    centres = np.eye(4)
    patches = unit(np.array([[[1.0, 0.1, 0.0, 0.0], [0.1, 0.0, 1.0, 0.0]]]))
    blocks = vlad(tensor(patches), tensor(centres)).reshape(4, 4)
    used = [bool((block != 0).any()) for block in blocks]
    assert used == [True, False, True, False]
    assert not vlad(tensor(centres[None]), tensor(centres)).any(), "patches equal their centres"
    alike = tensor(np.array([[0.0, 1.0], [1.0, 0.0], [2.0, 0.0]]))
    assert assign_clusters(tensor(np.array([[1.0, 0.0]])), alike).tolist() == [1]


Aggregate = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]
BOTH = pytest.mark.parametrize(
    "aggregate", [vlad, functools.partial(soft_vlad, temperature=2.0)], ids=["hard", "soft"]
)


@BOTH
def test_zero_patches_stay_out_of_the_sums_and_a_photo_of_nothing_else_is_similar_to_nothing(
    aggregate: Aggregate,
) -> None:
    features, centres = some_patches(5, 2, 7, 8), tensor(raw_centres(6, 4, 8))
    rows = aggregate(tensor(features), centres)
    blank = np.concatenate([np.zeros((2, 3, 8)), features, np.zeros((2, 1, 8))], axis=1)
    np.testing.assert_allclose(aggregate(tensor(blank), centres), rows, atol=1e-6)
    blank[0] = 0
    rows = aggregate(tensor(blank), centres)
    assert rows[0].tolist() == [0.0] * 32
    assert float(torch.linalg.norm(rows[1])) == pytest.approx(1.0, abs=1e-6)


@BOTH
def test_no_tensor_is_as_large_as_all_residuals(aggregate: Aggregate) -> None:
    patches, clusters, width = 60, 50, 70
    features, centres = some_patches(1, 2, patches, width), raw_centres(2, clusters, width)
    largest = 0

    class Watch(TorchDispatchMode):  # type: ignore[no-untyped-call]
        def __torch_dispatch__(
            self, func: Any, types: Any, args: Any = (), kwargs: Any = None
        ) -> Any:
            nonlocal largest
            found = func(*args, **(kwargs or {}))
            if isinstance(found, torch.Tensor):
                largest = max(largest, found.numel())
            return found

    with Watch():  # type: ignore[no-untyped-call]
        aggregate(tensor(features), tensor(centres))
    assert largest == 2 * max(patches * width, clusters * width)
