"""The scan against brute force: the same photos, in the same order, with the same scores."""

from __future__ import annotations

from collections.abc import Collection
from fractions import Fraction
from typing import Any
from uuid import UUID

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from services.search import dense_scan
from services.search.dense_scan import float32_error
from services.search.exact_rerank import RowBlocks
from services.search.photo_columns import build_row_mask
from services.search.snapshot import Snapshot
from shared.ids import new_id
from shared.search_api.photo_filter import NO_FILTER
from shared.search_api.protocol import SearchResponse
from shared.storage.chunks import StoredRows
from tests.unit.search.search_rows import (
    LAST_DECIMAL,
    Rows,
    answer,
    assert_best,
    brute_force,
    hits_of,
    photo,
    snapshot_of,
)

pytestmark = pytest.mark.numerics


def unit_rows(seed: int, count: int, dimension: int) -> Rows:
    rows = np.random.default_rng(seed).standard_normal((count, dimension)).astype(np.float32)
    return normalised(rows)


def normalised(rows: NDArray[np.float32]) -> Rows:
    found: Rows = rows / np.linalg.norm(rows, axis=-1, keepdims=True)
    return found.astype(np.float32)


def scan(
    snapshot: Snapshot,
    query: Rows,
    k: int,
    exclude: Collection[UUID] = (),
) -> SearchResponse:
    row_mask = build_row_mask(snapshot.photos, NO_FILTER, exclude)
    return answer(snapshot, query, row_mask, k)


@settings(max_examples=40)
@given(
    seed=st.integers(0, 2**31),
    count=st.integers(1, 40),
    dimension=st.integers(1, 9),
    pieces=st.integers(1, 4),
    k=st.integers(1, 50),
    duplicates=st.integers(0, 20),
    nearly=st.booleans(),
    row_type=st.sampled_from([np.float32, np.float16]),
    numpy_numbers=st.sampled_from([0, dense_scan.NUMPY_NUMBERS]),
    data=st.data(),
)
def test_answers_equal_brute_force_with_order_and_ties(
    seed: int,
    count: int,
    dimension: int,
    pieces: int,
    k: int,
    duplicates: int,
    nearly: bool,
    row_type: Any,
    numpy_numbers: int,
    data: st.DataObject,
) -> None:
    rng = np.random.default_rng(seed)
    rows = unit_rows(seed, count, dimension)
    for _ in range(duplicates):
        a, b = rng.integers(0, count, 2)
        rows[a] = rows[b]
        if nearly:
            rows[a, rng.integers(0, dimension)] += np.float32(1e-7)
    numbers = data.draw(st.permutations(range(count)))
    dead = frozenset(data.draw(st.sets(st.integers(0, count - 1), max_size=count // 2)))
    query = rows[rng.integers(0, count)] if data.draw(st.booleans()) else rows.sum(axis=0)
    if not np.linalg.norm(query):
        return
    stored: StoredRows = rows.astype(row_type)
    snapshot = snapshot_of(stored, pieces, coded=False, numbers=numbers, dead=dead)
    live = np.array([number not in dead for number in numbers])
    exact = dict(brute_force(stored, query, count, live, numbers=numbers))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dense_scan, "NUMPY_NUMBERS", numpy_numbers)
        found = scan(snapshot, query, k)
    assert_best(hits_of(found), exact, k)
    assert found.certificate == "exhaustive"
    assert found.rows_scanned == count - len(dead)
    assert len(found.hits) <= found.rows_reranked <= found.rows_scanned


def test_rows_opposite_to_the_query_are_ties_whatever_their_rounding() -> None:
    snapshot = snapshot_of(np.array([[1.0000004], [1.0]], np.float32), 1, coded=False)
    assert hits_of(scan(snapshot, np.array([-1.0], np.float32), 1)) == [(photo(0), -1.0)]


def test_the_kernel_is_compiled_in_advance_exactly_for_maps_that_use_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    used: set[type[Any]] = set()
    multiply = RowBlocks.multiply

    def record(blocks: RowBlocks, rows: Any, query: Rows, out: Any) -> None:
        used.add(out.dtype.type)
        multiply(blocks, rows, query, out)

    monkeypatch.setattr(RowBlocks, "multiply", record)
    rows = unit_rows(6, 80, 14_336)
    row_types: tuple[Any, ...] = (np.float16, np.float32)
    for row_type in row_types:
        for count, kinds in ((80, {np.float32, np.float64}), (60, set())):
            used.clear()
            stored: StoredRows = rows[:count].astype(row_type)
            snapshot = snapshot_of(stored, 1, coded=False)
            dense_scan.compile_kernel(snapshot)
            assert used == kinds
            scan(snapshot, rows[0], 5)
            assert used == kinds


def test_chunks_of_both_types_are_searched_as_one_map() -> None:
    """An extractor of an earlier release writes float32 into a generation of float16 rows."""
    rows = unit_rows(5, 30, 700)
    rows[:15] = rows[:15].astype(np.float16)
    halves = snapshot_of(rows[:15].astype(np.float16), 1, coded=False)
    wholes = snapshot_of(rows[15:], 1, coded=False, numbers=range(15, 30))
    snapshot = Snapshot(new_id(), new_id(), 1, halves.chunks + wholes.chunks)
    for query in rows[::7]:
        assert hits_of(scan(snapshot, query, 30)) == brute_force(rows, query, 30)
        products = np.empty(30)
        RowBlocks.of(snapshot.chunks).multiply(np.arange(30), query, products)
        np.testing.assert_allclose(products, rows.astype(np.float64) @ query, atol=1e-12)


@pytest.mark.parametrize("row_type", [np.float32, np.float16])
@pytest.mark.parametrize("seed", range(3))
def test_near_duplicates_at_7168_dimensions_are_distinguished(seed: int, row_type: Any) -> None:
    """Far below what float32 sums can tell: many rows, all within 1e-6 of each other."""
    rng = np.random.default_rng(seed)
    place = unit_rows(seed, 1, 7168)[0]
    rows = np.tile(place, (110, 1))
    rows += rng.standard_normal(rows.shape).astype(np.float32) * np.float32(3e-6)
    rows = normalised(rows)
    rows[10:20] = rows[30:40]  # and some of them the same
    rows = np.concatenate([rows, unit_rows(seed + 9, 40, 7168)])
    numbers = rng.permutation(150).tolist()
    stored: StoredRows = rows.astype(row_type)
    for k in (1, 7, 60, 200):
        snapshot = snapshot_of(stored, coded=False, numbers=numbers)
        expected = brute_force(stored, place, k, numbers=numbers)
        found = hits_of(scan(snapshot, place, k))
        assert [photo_id for photo_id, _ in found] == [photo_id for photo_id, _ in expected]
        scores = [score for _, score in expected]
        assert [score for _, score in found] == pytest.approx(scores, abs=LAST_DECIMAL)


def test_scores_equal_exact_arithmetic() -> None:
    """An independent reference: fractions, which do not round."""
    rows, query = unit_rows(1, 20, 33), unit_rows(2, 1, 33)[0]
    length = float(np.linalg.norm(query.astype(np.float64)))
    for photo_id, score in hits_of(scan(snapshot_of(rows, coded=False), query, 20)):
        row = rows[photo_id.int - 1]
        products = (
            Fraction(float(a)) * Fraction(float(b)) for a, b in zip(row, query, strict=True)
        )
        assert score == pytest.approx(float(sum(products)) / length, abs=1e-12)


@pytest.mark.parametrize("dimension", [1, 4096, 98_304])
def test_the_error_bound_covers_float32_sums_in_the_worst_order(dimension: int) -> None:
    """From the largest product to the smallest, none of them negative: each sum rounds."""
    rng = np.random.default_rng(dimension)
    products = np.sort(rng.exponential(size=(8, dimension)).astype(np.float32), axis=1)[:, ::-1]
    rows = normalised(np.sqrt(products)).astype(np.float16)
    query = normalised(np.sqrt(products[0]))
    exact = rows.astype(np.float64) @ query.astype(np.float64)
    in_order = np.cumsum(rows.astype(np.float32) * query, axis=1, dtype=np.float32)[:, -1]
    error = np.abs(in_order - exact).max()
    assert error < float32_error(dimension)
    assert dimension == 1 or error > float32_error(dimension) / 1000


def test_a_row_that_float32_sums_rank_too_low_is_found() -> None:
    """The product of the best row loses half of its numbers to rounding, the other's none."""
    dimension = 4097
    best = np.full(dimension, 2.0**-12.5, np.float32)
    best[0] = 1.0
    other = np.zeros(dimension, np.float32)
    other[0], other[1] = 1.0, 2.0**-11
    query = best
    snapshot = snapshot_of(np.stack([other, best]), 1, coded=False)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dense_scan, "_multiply", summed_in_order)
        assert hits_of(scan(snapshot, query, 1))[0][0] == photo(1)
        patch.setattr(dense_scan, "float32_error", lambda dimension: 0.0)
        assert hits_of(scan(snapshot, query, 1))[0][0] == photo(0)


def summed_in_order(snapshot: Snapshot, rows: Any, query: Rows, kind: Any) -> Any:
    stored = np.concatenate([chunk.rows for chunk in snapshot.chunks])[rows].astype(kind)
    return np.cumsum(stored * query.astype(kind), axis=1, dtype=kind)[:, -1]


def test_nothing_is_found_without_rows_or_with_a_query_of_zeros() -> None:
    rows = unit_rows(11, 2, 4)
    nothing = scan(Snapshot(new_id(), new_id(), 1, ()), rows[0], 5)
    assert (nothing.hits, nothing.certificate) == ((), "exhaustive")
    assert (nothing.rows_scanned, nothing.rows_reranked) == (0, 0)
    assert scan(snapshot_of(rows[:0], 1, coded=False), rows[0], 5) == nothing
    snapshot = snapshot_of(rows, coded=False, dead={0})
    assert scan(snapshot, rows[0], 2, exclude={photo(1)}).hits == ()
    assert scan(snapshot, np.zeros(4, np.float32), 2).hits == ()


@pytest.mark.parametrize("length", [1e-30, 1e-3, 1e6, 1e30])
def test_length_of_the_query_changes_nothing(length: float) -> None:
    rows = unit_rows(13, 10, 16)
    snapshot = snapshot_of(rows, coded=False)
    scaled = (rows[4].astype(np.float64) * length).astype(np.float32)
    found, plain = (hits_of(scan(snapshot, query, 10)) for query in (scaled, rows[4]))
    assert [hit[0] for hit in found] == [hit[0] for hit in plain]
    np.testing.assert_allclose([hit[1] for hit in found], [hit[1] for hit in plain], atol=1e-6)


@pytest.mark.parametrize("dimension", [1, 3, 512, 7168])
def test_scores_are_cosines_between_minus_one_and_one(dimension: int) -> None:
    rows = unit_rows(14, 30, dimension)
    rows = np.concatenate([rows, -rows])
    # A little longer than a unit vector, as rounding leaves them.
    rows *= np.float32(1 + 3e-7)
    for query in rows[:5]:
        scores = [score for _, score in hits_of(scan(snapshot_of(rows, coded=False), query, 60))]
        assert all(-1.0 <= score <= 1.0 for score in scores)
        assert scores[0] == pytest.approx(1.0, abs=1e-6)
        assert scores[-1] == pytest.approx(-1.0, abs=1e-6)
