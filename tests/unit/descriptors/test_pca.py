"""PCA whitening: scikit-learn's numbers, in the memory that a large dimension leaves."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import torch
from sklearn.decomposition import PCA

from shared.descriptors.pca_fit import (
    SAMPLE_BYTES,
    fit_pca,
    fit_pca_stream,
    sample_rows,
    sample_size,
)
from shared.descriptors.pca_whitening import (
    PcaProjection,
    PcaWhitening,
    PcaWhiteningFile,
    Rows,
    decode_whitening,
)
from shared.errors import Unprocessable

pytestmark = pytest.mark.numerics

CPU = torch.device("cpu")


def unit_rows(count: int, dimension: int, seed: int = 0) -> Rows:
    """Rows around a common direction, as descriptors lie, whose variances fall like 1 / j."""
    rng = np.random.default_rng(seed)
    strength = 1 / np.sqrt(1 + np.arange(dimension))
    turned = np.linalg.qr(rng.standard_normal((dimension, dimension)))[0]
    rows = (rng.standard_normal((count, dimension)) * strength) @ turned + 3 * turned[0]
    units: Rows = (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)
    return units


def projected(rows: Rows, by: PcaWhitening) -> Rows:
    return PcaProjection(by, CPU).project(rows)


def refusal(code: str, rows: Rows, components: int) -> str:
    with pytest.raises(Unprocessable) as caught:
        fit_pca(rows, components)
    assert caught.value.code == code
    return caught.value.detail


# --- the mathematics -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("count", "dimension", "components"),
    [
        (60, 200, 12),
        (200, 200, 30),
        (400, 50, 12),
        (400, 50, 50),
        (31, 500, 29),
        (60, 16, 4),  # NumPy 2.4 negates rows of four float32 wrongly, in place and by columns
    ],
)
def test_rows_are_whitened_as_by_scikit_learn(count: int, dimension: int, components: int) -> None:
    rows, queries = unit_rows(count, dimension), unit_rows(20, dimension, seed=1)
    ours = fit_pca(rows, components, block_bytes=40_000)
    theirs = PCA(n_components=components, whiten=True, svd_solver="full").fit(
        rows.astype(np.float64)
    )
    expected = theirs.transform(queries.astype(np.float64))
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    signs = np.sign((ours.directions * theirs.components_).sum(axis=1))
    np.testing.assert_allclose(projected(queries, ours) * signs, expected, atol=2e-4)
    np.testing.assert_allclose(ours.variances, theirs.explained_variance_, rtol=1e-4)
    assert ours.explained == pytest.approx(theirs.explained_variance_ratio_.sum(), rel=1e-5)
    assert (ours.components, ours.dimension, ours.rows) == (components, dimension, count)


def test_signs_do_not_depend_on_how_the_directions_were_found() -> None:
    by = fit_pca(unit_rows(70, 300), 10)
    strongest = np.abs(by.directions).argmax(axis=1)
    assert (by.directions[np.arange(10), strongest] > 0).all()


def test_fit_holds_no_matrix_of_the_dimension(tmp_path: Path) -> None:
    dimension, count, retained = 98_304, 40, 8
    file = np.memmap(tmp_path / "rows", np.float32, "w+", shape=(count, dimension))
    rng = np.random.default_rng(3)
    for row in file:
        row[:] = rng.standard_normal(dimension, dtype=np.float32)
    tracemalloc.start()
    by = fit_pca(file, retained, block_bytes=1_000_000)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert by.directions.shape == (retained, dimension)
    result = by.directions.nbytes + 8 * dimension + by.mean.nbytes
    assert peak < result + 5_000_000, "the rows alone have 15.7 MB, and are never held together"


def test_whitening_maps_the_mean_and_zero_rows_to_zero_and_keeps_nan() -> None:
    by = fit_pca(unit_rows(70, 30), 5)
    rows = np.stack([by.mean, np.zeros(30, np.float32), np.full(30, np.nan, np.float32)])
    found = projected(rows, by)
    assert not found[:2].any()
    assert np.isnan(found[2]).all()


# --- the sample ------------------------------------------------------------------------------


def test_batches_are_fitted_as_their_usable_rows_in_memory() -> None:
    rows = unit_rows(50, 200)
    rows[3], rows[9, 2] = 0, np.nan
    batches = [rows[begin : begin + 7] for begin in range(0, 50, 7)]
    steps: list[tuple[str, int, int]] = []
    fitted = fit_pca_stream(batches, 50, 200, 5, lambda *step: steps.append(step))
    assert steps[7] == ("gather", 50, 50)
    reducing = steps[8:]
    total = len(reducing)
    assert reducing == [("reduce", done, total) for done in range(1, total + 1)]
    assert fitted.sha256 == fit_pca(np.delete(rows, [3, 9], axis=0), 5).sha256


def test_the_sample_is_large_enough_for_the_directions_and_small_enough_for_the_disk() -> None:
    assert sample_size(7168, 128) == 1000
    assert sample_size(7168, 512) == 2048
    assert sample_size(98_304, 512) == 2048
    assert sample_size(98_304, 1024) == SAMPLE_BYTES // (4 * 98_304) == 2543
    assert sample_size(10_000_000, 100) == 200


def test_a_sample_is_the_same_for_its_seed_and_ascends() -> None:
    chosen = sample_rows(40, 10, 0)
    assert sorted(set(chosen)) == list(chosen)
    assert len(chosen) == 10
    np.testing.assert_array_equal(chosen, sample_rows(40, 10, 0))
    assert list(sample_rows(40, 10, 1)) != list(chosen)
    assert list(sample_rows(4, 10, 0)) == [0, 1, 2, 3]


# --- what is refused -------------------------------------------------------------------------


def test_more_rows_and_no_fewer_dimensions_than_components_are_needed() -> None:
    refusal("pca_too_many_dimensions", unit_rows(100, 16), 17)
    assert "needs more than 20 described photos" in refusal(
        "pca_too_few_rows", unit_rows(20, 64), 20
    )
    assert fit_pca(unit_rows(21, 64), 20).components == 20


@pytest.mark.parametrize("count", [30, 500])
def test_more_components_than_the_rows_vary_in_are_refused(count: int) -> None:
    few = unit_rows(count, 5) @ np.random.default_rng(2).standard_normal((5, 100))
    rows = few.astype(np.float32)
    assert "vary in 5 directions only" in refusal("pca_too_many_dimensions", rows, 10)
    same = np.ones((count, 100), dtype=np.float32)
    assert "vary in 0 directions only" in refusal("pca_too_many_dimensions", same, 2)


# --- files -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def fitted() -> PcaWhitening:
    return fit_pca(unit_rows(70, 30), 6)


def test_a_file_holds_the_whole_whitening(fitted: PcaWhitening) -> None:
    spec = {"extractor": "test", "preprocessing": {"version": 1}}
    data = PcaWhiteningFile(fitted, spec).encode()
    read = decode_whitening(data)
    back = read.whitening
    for name in ("mean", "directions", "variances"):
        np.testing.assert_array_equal(getattr(back, name), getattr(fitted, name))
    assert (back.explained, back.rows, back.sha256) == (
        fitted.explained,
        fitted.rows,
        fitted.sha256,
    )
    assert read.spec == spec
    assert read.encode() == data


def test_a_whitening_fits_the_descriptors_that_it_was_learnt_from(fitted: PcaWhitening) -> None:
    spec = {"dimension": 30, "backbone": "a", "layer": 3, "decoder": "1", "precision": "float32"}
    known = PcaWhiteningFile(fitted, spec)
    known.check_compatible({**spec, "decoder": "2", "precision": "float16"})
    with pytest.raises(Unprocessable, match="layer is 4, was 3") as caught:
        known.check_compatible({**spec, "layer": 4})
    assert caught.value.code == "pca_unusable"
    with pytest.raises(Unprocessable, match="dimension is 31, was 30"):
        known.check_compatible({**spec, "dimension": 31})


def test_files_that_are_no_whitening_are_refused(fitted: PcaWhitening) -> None:
    data = PcaWhiteningFile(fitted, {}).encode()
    for broken in (b"", b"\x93NUMPY", data[:-1], data[:100], data + b"x"):
        with pytest.raises(Unprocessable, match="or it is truncated") as caught:
            decode_whitening(broken)
        assert caught.value.code == "pca_unusable"
