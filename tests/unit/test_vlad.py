"""VLAD against the published formula, patch by patch (Jegou et al. 2010; AnyLoc, RA-L 2023)."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from shared.vision.vlad import assign, vlad

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


def test_centre_is_subtracted_raw_and_not_normalised() -> None:
    centres = np.array([[0.5, 0.0], [0.0, 0.1]])
    patches = unit(np.array([[[1.0, 0.2], [1.0, 0.4], [0.1, 1.0]]]))
    raw = slow_vlad(patches[0], centres)
    normalised = slow_vlad(patches[0], unit(centres))
    assert np.abs(raw - normalised).max() > 0.1
    np.testing.assert_allclose(vlad(tensor(patches), tensor(centres))[0], raw, atol=1e-6)


def test_assignment_is_by_cosine_so_a_long_centre_attracts_no_more() -> None:
    centres = tensor(np.array([[10.0, 0.0], [0.1, 0.1]]))
    patches = tensor(unit(np.array([[1.0, 0.9], [1.0, 0.1]])))
    assert assign(patches, centres).tolist() == [1, 0]


def test_first_of_equally_similar_centres_gets_the_patch() -> None:
    centres = tensor(np.array([[0.0, 1.0], [1.0, 0.0], [2.0, 0.0]]))
    assert assign(tensor(np.array([[1.0, 0.0]])), centres).tolist() == [1]


def test_unused_clusters_stay_exactly_zero() -> None:
    centres = np.eye(4)
    patches = unit(np.array([[[1.0, 0.1, 0.0, 0.0], [0.1, 0.0, 1.0, 0.0]]]))
    blocks = vlad(tensor(patches), tensor(centres)).reshape(4, 4)
    used = [bool((block != 0).any()) for block in blocks]
    assert used == [True, False, True, False]


def test_used_clusters_weigh_alike_and_the_row_has_unit_norm() -> None:
    features = some_patches(3, 5, 60, 12)
    rows = vlad(tensor(features), tensor(raw_centres(4, 6, 12)))
    np.testing.assert_allclose(torch.linalg.norm(rows, dim=1), 1.0, atol=1e-6)
    norms = torch.linalg.norm(rows.reshape(5, 6, 12), dim=2)
    for photo in norms:
        used = photo[photo > 0]
        np.testing.assert_allclose(used, 1 / math.sqrt(len(used)), atol=1e-6)


def test_blocks_stand_cluster_by_cluster() -> None:
    centres = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    only_second = unit(np.array([[[0.1, 1.0, 0.3]]]))
    row = vlad(tensor(only_second), tensor(centres))[0]
    assert row[:3].tolist() == [0.0, 0.0, 0.0]
    assert float(torch.linalg.norm(row[3:])) == pytest.approx(1.0)


def test_photo_of_zero_patches_gives_finite_numbers() -> None:
    features = np.zeros((2, 7, 8))
    features[1] = some_patches(5, 1, 7, 8)[0]
    rows = vlad(tensor(features), tensor(raw_centres(6, 4, 8)))
    assert bool(torch.isfinite(rows).all())
    assert float(torch.linalg.norm(rows[1])) == pytest.approx(1.0, abs=1e-6)


def test_patches_that_equal_their_centre_leave_a_zero_row() -> None:
    centres = np.eye(3)
    rows = vlad(tensor(centres[None]), tensor(centres))
    assert rows.tolist() == [[0.0] * 9]


def test_rows_do_not_depend_on_the_batch_they_come_in() -> None:
    features = tensor(some_patches(7, 9, 40, 16))
    centres = tensor(raw_centres(8, 8, 16))
    together = vlad(features, centres)
    for size in (1, 2, 4, 5):
        parts = [vlad(features[i : i + size], centres) for i in range(0, 9, size)]
        np.testing.assert_allclose(torch.cat(parts), together, atol=1e-6)
