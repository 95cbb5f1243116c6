"""The scan against brute force: the same photos, in the same order, with the same scores."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from itertools import pairwise
from typing import Any
from uuid import UUID

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from services.search import dense_scan
from services.search.chunk_loader import LoadedChunk
from services.search.dense_scan import FLOAT32_MARGIN
from services.search.exact_rerank import RowBlocks
from services.search.executor import SCORE_DECIMALS, SearchOptions, execute_query
from services.search.photo_columns import PhotoColumns, build_row_mask
from services.search.query_batcher import QueryBatcher
from services.search.snapshot import Snapshot
from shared.ids import new_id
from shared.search_api.photo_filter import NO_FILTER
from shared.search_api.protocol import SearchResponse
from shared.storage.chunks import StoredRows
from tests.unit.search.search_rows import assert_best, facts_of

pytestmark = pytest.mark.numerics

Rows = NDArray[np.float32]


def unit_rows(seed: int, count: int, dimension: int) -> Rows:
    rows = np.random.default_rng(seed).standard_normal((count, dimension)).astype(np.float32)
    return normalised(rows)


def normalised(rows: NDArray[np.float32]) -> Rows:
    found: Rows = rows / np.linalg.norm(rows, axis=-1, keepdims=True)
    return found.astype(np.float32)


def photo(number: int) -> UUID:
    """An id whose order is that of the numbers."""
    return UUID(int=number + 1)


def chunk_of(
    rows: StoredRows, numbers: list[int], dead: frozenset[int] = frozenset()
) -> LoadedChunk:
    live = [
        (row, facts_of(photo(number))) for row, number in enumerate(numbers) if number not in dead
    ]
    return LoadedChunk(new_id(), "chunks/test.npy", rows, PhotoColumns.of(len(rows), live))


def split(
    rows: StoredRows, pieces: int, numbers: list[int], dead: frozenset[int] = frozenset()
) -> list[LoadedChunk]:
    """The rows in several chunks of different sizes."""
    bounds = np.linspace(0, len(rows), pieces + 1).astype(int)
    return [chunk_of(rows[a:b], numbers[a:b], dead) for a, b in pairwise(bounds)]


def brute_force(
    rows: StoredRows, numbers: list[int], query: Rows, k: int, dead: frozenset[int] = frozenset()
) -> list[tuple[UUID, float]]:
    exact = query.astype(np.float64)
    exact /= np.linalg.norm(exact)
    scored = [
        (
            -round(float(np.clip(row.astype(np.float64) @ exact, -1, 1)), SCORE_DECIMALS),
            photo(number),
        )
        for row, number in zip(rows, numbers, strict=True)
        if number not in dead
    ]
    return [(photo_id, -score) for score, photo_id in sorted(scored)[:k]]


def hits_of(
    chunks: list[LoadedChunk],
    query: Rows,
    k: int,
    min_score: float | None = None,
    exclude: frozenset[UUID] = frozenset(),
) -> list[tuple[UUID, float]]:
    found = ask(chunks, query, SearchOptions(k, min_score), exclude)
    return [(hit.photo_id, hit.score) for hit in found.hits]


def ask(
    chunks: list[LoadedChunk],
    query: Rows,
    question: SearchOptions,
    exclude: frozenset[UUID] = frozenset(),
) -> SearchResponse:
    snapshot = Snapshot(new_id(), new_id(), 1, tuple(chunks))
    return execute_query(
        snapshot,
        query,
        build_row_mask(snapshot.photos, NO_FILTER, exclude),
        question,
        QueryBatcher(),
    )


@settings(max_examples=80, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    count=st.integers(1, 40),
    dimension=st.integers(1, 9),
    pieces=st.integers(1, 4),
    k=st.integers(1, 50),
    duplicates=st.integers(0, 20),
    nearly=st.booleans(),
    row_type=st.sampled_from([np.float32, np.float16]),
    numpy_numbers=st.sampled_from([0, dense_scan.NUMPY_FLOAT16_NUMBERS]),
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
    chunks = split(stored, pieces, numbers, dead)
    exact = dict(brute_force(stored, numbers, query, count, dead))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dense_scan, "NUMPY_FLOAT16_NUMBERS", numpy_numbers)
        found = ask(chunks, query, SearchOptions(k))
    assert_best([(hit.photo_id, hit.score) for hit in found.hits], exact, k)
    assert found.certificate == "exhaustive"
    assert found.rows_scanned == count - len(dead)
    assert len(found.hits) <= found.rows_reranked <= found.rows_scanned


def test_the_kernel_is_compiled_in_advance_exactly_for_maps_that_use_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    cosines = dense_scan._kernel_cosines
    used: list[int] = []

    def record(chunks: Sequence[LoadedChunk], query: Rows, rows: NDArray[np.int64]) -> Any:
        used.append(len(rows))
        return cosines(chunks, query, rows)

    monkeypatch.setattr(dense_scan, "_kernel_cosines", record)
    rows = unit_rows(6, 80, 14_336)
    cases: list[tuple[StoredRows, bool]] = [
        (rows.astype(np.float16), True),
        (rows[:60].astype(np.float16), False),
        (rows, False),
    ]
    for stored, uses in cases:
        used.clear()
        count = len(stored)
        chunks = [chunk_of(stored, list(range(count)))]
        dense_scan.compile_kernel(chunks)
        assert used == [1] * uses
        ask(chunks, rows[0], SearchOptions(5))
        assert used == [1, count] * uses


def test_chunks_of_both_types_are_searched_as_one_map() -> None:
    """An extractor of an earlier release writes float32 into a generation of float16 rows."""
    rows = unit_rows(5, 30, 700)
    rows[:15] = rows[:15].astype(np.float16)
    chunks = [
        chunk_of(rows[:15].astype(np.float16), list(range(15))),
        chunk_of(rows[15:], list(range(15, 30))),
    ]
    for query in rows[::7]:
        assert hits_of(chunks, query, 30) == brute_force(rows, list(range(30)), query, 30)
        blocks = RowBlocks.of(chunks)
        products = np.empty(30)
        blocks.multiply(np.arange(30), query, products)
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
        found = hits_of(split(stored, 3, numbers), place, k)
        assert found == brute_force(stored, numbers, place, k)


def test_scores_equal_exact_arithmetic() -> None:
    """An independent reference: fractions, which do not round."""
    rows, query = unit_rows(1, 20, 33), unit_rows(2, 1, 33)[0]
    length = float(np.linalg.norm(query.astype(np.float64)))
    for photo_id, score in hits_of([chunk_of(rows, list(range(20)))], query, 20):
        row = rows[photo_id.int - 1]
        products = (
            Fraction(float(a)) * Fraction(float(b)) for a, b in zip(row, query, strict=True)
        )
        assert score == pytest.approx(float(sum(products)) / length, abs=1e-12)


def test_margin_covers_what_float32_sums_err_at_98304_dimensions() -> None:
    rows = unit_rows(3, 12, 98_304)
    query = normalised(rows[:1] + unit_rows(4, 1, 98_304) * np.float32(0.1))[0]
    exact = rows.astype(np.float64) @ query.astype(np.float64)
    assert np.abs(rows @ query - exact).max() < FLOAT32_MARGIN / 4


def test_equal_scores_are_ordered_by_photo_id_across_chunks() -> None:
    row = unit_rows(5, 1, 8)
    chunks = [chunk_of(row, [number]) for number in (4, 1, 3, 0, 2)]
    assert [hit[0] for hit in hits_of(chunks, row[0], 3)] == [photo(0), photo(1), photo(2)]


def test_dead_rows_are_never_answered_even_when_they_fit_best() -> None:
    rows = unit_rows(6, 5, 8)
    chunks = [chunk_of(rows, list(range(5)), dead=frozenset({2, 4}))]
    found = {hit[0] for hit in hits_of(chunks, rows[2], 5)}
    assert found == {photo(0), photo(1), photo(3)}


def test_dead_rows_need_no_photo() -> None:
    rows = unit_rows(6, 3, 8)
    live = [(0, facts_of(photo(0))), (2, facts_of(photo(2)))]
    chunk = LoadedChunk(new_id(), "chunks/test.npy", rows, PhotoColumns.of(len(rows), live))
    found = hits_of([chunk], rows[1], 3, exclude=frozenset({photo(2)}))
    assert [hit[0] for hit in found] == [photo(0)]


def test_excluded_photos_make_room_for_the_next() -> None:
    rows = unit_rows(7, 6, 8)
    chunks = split(rows, 2, list(range(6)))
    everything = hits_of(chunks, rows[3], 6)
    assert everything[0][0] == photo(3)
    without = hits_of(chunks, rows[3], 3, exclude=frozenset({photo(3), everything[2][0]}))
    assert without == [everything[1], everything[3], everything[4]]


def test_min_score_is_inclusive() -> None:
    rows = unit_rows(8, 9, 5)
    chunks = [chunk_of(rows, list(range(9)))]
    everything = hits_of(chunks, rows[0], 9)
    bound = everything[4][1]
    assert hits_of(chunks, rows[0], 9, min_score=bound) == everything[:5]
    assert hits_of(chunks, rows[0], 9, min_score=np.nextafter(bound, 2.0)) == everything[:4]
    assert hits_of(chunks, rows[0], 9, min_score=-1.0) == everything


def test_fewer_rows_than_k_are_all_returned() -> None:
    rows = unit_rows(9, 3, 4)
    assert len(hits_of([chunk_of(rows, [0, 1, 2])], rows[0], 100)) == 3


def test_nothing_loaded_answers_nothing() -> None:
    query = unit_rows(1, 1, 4)[0]
    nothing = ask([], query, SearchOptions(5))
    assert (nothing.hits, nothing.certificate) == ((), "exhaustive")
    assert (nothing.rows_scanned, nothing.rows_reranked) == (0, 0)
    empty = chunk_of(np.empty((0, 4), dtype=np.float32), [])
    assert ask([empty], query, SearchOptions(5)) == nothing


def test_empty_chunk_between_others_shifts_nothing() -> None:
    rows = unit_rows(10, 4, 4)
    empty = chunk_of(np.empty((0, 4), dtype=np.float32), [])
    chunks = [chunk_of(rows[:2], [0, 1]), empty, chunk_of(rows[2:], [2, 3])]
    assert hits_of(chunks, rows[3], 4) == brute_force(rows, [0, 1, 2, 3], rows[3], 4)


def test_all_rows_dead_or_excluded_answers_nothing() -> None:
    rows = unit_rows(11, 2, 4)
    chunks = [chunk_of(rows, [0, 1], dead=frozenset({0}))]
    assert hits_of(chunks, rows[0], 2, exclude=frozenset({photo(1)})) == []


def test_zero_query_answers_nothing() -> None:
    rows = unit_rows(12, 3, 4)
    assert hits_of([chunk_of(rows, [0, 1, 2])], np.zeros(4, dtype=np.float32), 3) == []


@pytest.mark.parametrize("length", [1e-30, 1e-3, 1.0, 1e6, 1e30])
def test_length_of_the_query_changes_nothing(length: float) -> None:
    rows = unit_rows(13, 10, 16)
    chunks = [chunk_of(rows, list(range(10)))]
    scaled = (rows[4].astype(np.float64) * length).astype(np.float32)
    found = hits_of(chunks, scaled, 10)
    plain = hits_of(chunks, rows[4], 10)
    assert [hit[0] for hit in found] == [hit[0] for hit in plain]
    np.testing.assert_allclose([hit[1] for hit in found], [hit[1] for hit in plain], atol=1e-6)


@pytest.mark.parametrize("dimension", [1, 3, 512, 7168])
def test_scores_are_cosines_between_minus_one_and_one(dimension: int) -> None:
    rows = unit_rows(14, 30, dimension)
    rows = np.concatenate([rows, -rows])
    # A little longer than a unit vector, as rounding leaves them.
    rows *= np.float32(1 + 3e-7)
    for query in rows[:5]:
        scores = [hit[1] for hit in hits_of([chunk_of(rows, list(range(60)))], query, 60)]
        assert all(-1.0 <= score <= 1.0 for score in scores)
        assert scores[0] == pytest.approx(1.0, abs=1e-6)
        assert scores[-1] == pytest.approx(-1.0, abs=1e-6)
