"""PCA whitening: scikit-learn's numbers, in the memory that a large dimension leaves."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from safetensors.numpy import load, save
from sklearn.decomposition import PCA

from shared.errors import Unprocessable
from shared.vision import pca
from shared.vision.pca import Whitening, fit, gather, whiten
from shared.vision.pca_file import decode_whitening, encode_whitening

Rows = NDArray[np.float32]


def unit_rows(count: int, dimension: int, seed: int = 0) -> Rows:
    """Rows around a common direction, as descriptors lie, whose variances fall like 1 / j."""
    rng = np.random.default_rng(seed)
    strength = 1 / np.sqrt(1 + np.arange(dimension))
    turned = np.linalg.qr(rng.standard_normal((dimension, dimension)))[0]
    rows = (rng.standard_normal((count, dimension)) * strength) @ turned + 3 * turned[0]
    units: Rows = (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)
    return units


def projected(rows: Rows, by: Whitening) -> Rows:
    tensors = (torch.from_numpy(array) for array in (rows, by.mean, by.directions))
    out: Rows = whiten(*tensors).numpy()
    return out


def refusal(code: str, rows: Rows, kept: int) -> str:
    with pytest.raises(Unprocessable) as caught:
        fit(rows, kept)
    assert caught.value.code == code
    return caught.value.detail


# --- the mathematics -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("count", "dimension", "kept"),
    [(60, 200, 12), (200, 200, 30), (400, 50, 12), (400, 50, 50), (31, 500, 29)],
)
def test_rows_are_whitened_as_by_scikit_learn(count: int, dimension: int, kept: int) -> None:
    rows, queries = unit_rows(count, dimension), unit_rows(20, dimension, seed=1)
    ours = fit(rows, kept, block_bytes=40_000)
    theirs = PCA(n_components=kept, whiten=True, svd_solver="full").fit(rows.astype(np.float64))
    expected = theirs.transform(queries.astype(np.float64))
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    signs = np.sign((ours.directions * theirs.components_).sum(axis=1))
    np.testing.assert_allclose(projected(queries, ours) * signs, expected, atol=2e-4)
    np.testing.assert_allclose(ours.variances, theirs.explained_variance_, rtol=1e-4)
    assert ours.explained == pytest.approx(theirs.explained_variance_ratio_.sum(), rel=1e-5)
    assert (ours.kept, ours.dimension, ours.rows) == (kept, dimension, count)


def test_both_ways_give_the_same_projection() -> None:
    rows = unit_rows(150, 150)
    mean, variances, directions, total = pca._by_covariance(rows, 20, 10_000)
    by_gram = pca._by_gram(rows, 20, 10_000)
    np.testing.assert_allclose(by_gram[0], mean, atol=1e-12)
    np.testing.assert_allclose(by_gram[1], variances, rtol=1e-9)
    np.testing.assert_allclose(np.abs(by_gram[2]), np.abs(directions), atol=1e-4)
    assert by_gram[3] == pytest.approx(total)


def test_whitened_rows_vary_equally_in_all_directions() -> None:
    rows = unit_rows(500, 80)
    by = fit(rows, 16)
    flat = (rows - by.mean) @ by.directions.T
    np.testing.assert_allclose(np.cov(flat.T), np.eye(16), atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(projected(rows, by), axis=1), 1, atol=1e-5)


def test_blocks_make_no_difference() -> None:
    rows = unit_rows(70, 300)
    whole, pieces = fit(rows, 10), fit(rows, 10, block_bytes=1)
    np.testing.assert_allclose(whole.directions, pieces.directions, atol=1e-4)
    np.testing.assert_allclose(whole.mean, pieces.mean, atol=1e-7)


def test_signs_do_not_depend_on_how_the_directions_were_found() -> None:
    by = fit(unit_rows(70, 300), 10)
    strongest = np.abs(by.directions).argmax(axis=1)
    assert (by.directions[np.arange(10), strongest] > 0).all()


def test_fit_holds_no_matrix_of_the_dimension(tmp_path: Path) -> None:
    dimension, count, kept = 98_304, 40, 8
    file = np.memmap(tmp_path / "rows", np.float32, "w+", shape=(count, dimension))
    rng = np.random.default_rng(3)
    for row in file:
        row[:] = rng.standard_normal(dimension, dtype=np.float32)
    tracemalloc.start()
    by = fit(file, kept, block_bytes=1_000_000)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert by.directions.shape == (kept, dimension)
    result = by.directions.nbytes + 8 * dimension + by.mean.nbytes
    assert peak < result + 5_000_000, "the rows alone have 15.7 MB, and are never held together"


def test_a_row_that_is_the_mean_becomes_zero() -> None:
    by = fit(unit_rows(70, 30), 5)
    assert not projected(by.mean[np.newaxis], by).any()


# --- the sample ------------------------------------------------------------------------------


def stream(rows: Rows, size: int) -> Iterator[Rows]:
    for begin in range(0, len(rows), size):
        yield rows[begin : begin + size]


def test_a_short_stream_is_taken_whole(tmp_path: Path) -> None:
    rows = unit_rows(30, 8)
    np.testing.assert_array_equal(gather(stream(rows, 7), 8, tmp_path, rows=30, seed=0), rows)
    longer = gather(stream(rows, 7), 8, tmp_path, rows=99, seed=0)
    np.testing.assert_array_equal(longer, rows)


def test_of_a_long_stream_each_row_is_taken_as_often(tmp_path: Path) -> None:
    numbers = np.arange(40, dtype=np.float32)[:, np.newaxis]
    taken = np.zeros(40)
    for seed in range(400):
        sample = gather(stream(numbers, 9), 1, tmp_path, rows=10, seed=seed)
        assert len(np.unique(sample)) == 10
        taken[sample[:, 0].astype(int)] += 1
    # Each is expected 100 times, with a standard deviation of 8.7.
    assert np.abs(taken - 100).max() < 5 * 8.7


def test_a_sample_does_not_depend_on_how_the_stream_is_cut(tmp_path: Path) -> None:
    rows = unit_rows(50, 4)
    one = np.array(gather(stream(rows, 50), 4, tmp_path, rows=10, seed=5))
    other = np.array(gather(stream(rows, 3), 4, tmp_path, rows=10, seed=5))
    np.testing.assert_array_equal(one, other)


# --- what is refused -------------------------------------------------------------------------


def test_more_rows_than_dimensions_are_needed() -> None:
    assert "needs more than 20 described photos" in refusal(
        "pca_too_few_rows", unit_rows(20, 64), 20
    )
    assert fit(unit_rows(21, 64), 20).kept == 20


def test_descriptors_do_not_become_longer() -> None:
    refusal("pca_too_many_dimensions", unit_rows(100, 16), 17)


@pytest.mark.parametrize("count", [30, 500])
def test_photos_that_are_all_alike_bear_few_directions(count: int) -> None:
    few = unit_rows(count, 5) @ np.random.default_rng(2).standard_normal((5, 100))
    rows = few.astype(np.float32)
    assert "vary in 5 directions only" in refusal("pca_too_many_dimensions", rows, 10)
    same = np.ones((count, 100), dtype=np.float32)
    assert "vary in 0 directions only" in refusal("pca_too_many_dimensions", same, 2)


# --- files -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def fitted() -> Whitening:
    return fit(unit_rows(70, 30), 6)


def test_a_file_holds_the_whole_whitening(fitted: Whitening) -> None:
    data = encode_whitening(fitted)
    back = decode_whitening(data, dimension=30)
    for name in ("mean", "directions", "variances"):
        np.testing.assert_array_equal(getattr(back, name), getattr(fitted, name))
    assert (back.explained, back.rows, back.sha256) == (
        fitted.explained,
        fitted.rows,
        fitted.sha256,
    )
    assert encode_whitening(back) == data


def test_fingerprint_is_that_of_the_projection(fitted: Whitening) -> None:
    assert fit(unit_rows(70, 30), 6).sha256 == fitted.sha256
    assert fit(unit_rows(70, 30, seed=1), 6).sha256 != fitted.sha256


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("mean", None, "no mean"),
        ("rows", None, "no rows"),
        ("mean", np.zeros(29, np.float32), "do not belong together"),
        ("directions", np.zeros(30, np.float32), "do not belong together"),
        ("variances", np.ones(5, np.float32), "do not belong together"),
        ("variances", -np.ones(6, np.float32), "not positive"),
        ("variances", np.full(6, 9, np.float32), "not those of its variances"),
        ("mean", np.full(30, np.nan, np.float32), "NaN"),
        ("mean", np.zeros(30, np.float64), "float64, not float32"),
        ("rows", np.zeros(2, np.int64), "one number each"),
    ],
)
def test_files_that_would_spoil_descriptors_are_refused(
    fitted: Whitening, name: str, value: NDArray[np.generic] | None, said: str
) -> None:
    stored = load(encode_whitening(fitted))
    if value is None:
        del stored[name]
    else:
        stored[name] = value
    assert said in unfit(save(stored))


def test_files_that_are_none_are_refused(fitted: Whitening) -> None:
    data = encode_whitening(fitted)
    for broken in (b"", b"\x93NUMPY", data[:-1], data[:100], data + b"x"):
        assert "not a whole one" in unfit(broken)
    assert "of 30 dimensions, and these have 31" in unfit(data, dimension=31)


def unfit(data: bytes, dimension: int | None = None) -> str:
    with pytest.raises(Unprocessable) as caught:
        decode_whitening(data, dimension=dimension)
    assert caught.value.code == "pca_unfit"
    return caught.value.detail
