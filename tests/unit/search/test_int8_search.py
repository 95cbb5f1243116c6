"""Search by int8 codes against brute force in float64: the same rows, in the same order, and no
row further off than its bound."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.search import executor
from services.search.executor import SearchOptions, int8_codes_pay_off
from shared.search_api.protocol import Mode
from tests.unit.search.search_rows import (
    Case,
    answer,
    assert_best,
    brute_force,
    cases,
    hits_of,
    photo,
    places,
    snapshot_of,
)

pytestmark = pytest.mark.numerics

DIMENSION = 512


@pytest.fixture(autouse=True)
def by_int8(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(executor, "int8_codes_pay_off", lambda *_: True)


@settings(max_examples=60, deadline=None)
@given(case=cases(DIMENSION), mode=st.sampled_from([Mode.AUTO, Mode.DETERMINISTIC]))
def test_answers_equal_brute_force_with_order_and_ties(case: Case, mode: Mode) -> None:
    snapshot = snapshot_of(case.rows, case.pieces, "int8")
    found = answer(snapshot, case.query, case.selected, SearchOptions(case.k, case.min_score, mode))
    assert_best(hits_of(found), case.exact, case.k)
    if case.selected.any():
        assert found.certificate == "bound"
        assert found.certified_k == len(found.hits)
        assert found.rows_scanned == int(case.selected.sum())
        assert found.max_z is None


@pytest.mark.parametrize("dimension", [2, 64, 100, 1280, 7168, 98_304])
def test_rows_of_any_length_are_searched(dimension: int) -> None:
    rows = places(3, 30, dimension)
    everything = np.ones(30, bool)
    snapshot = snapshot_of(rows, by="int8")
    for query in rows[:2]:
        found = answer(snapshot, query, everything, SearchOptions(7, mode=Mode.DETERMINISTIC))
        assert_best(hits_of(found), dict(brute_force(rows, query, len(rows), everything)), 7)
        assert found.certificate == "bound"


def test_most_rows_are_never_read_when_the_place_is_in_the_map() -> None:
    rows = places(1, 3000, DIMENSION)
    query = rows[77] + np.float32(0.02) * places(9, 1, DIMENSION)[0]
    found = answer(snapshot_of(rows, by="int8"), query, np.ones(3000, bool), SearchOptions(1))
    assert found.hits[0].photo_id == photo(77)
    assert found.rows_scanned == 3000
    assert found.rows_reranked < 30


def test_query_of_any_length_gives_the_same_answer() -> None:
    rows = places(2, 100, DIMENSION)
    everything = np.ones(100, bool)
    snapshot = snapshot_of(rows, by="int8")
    scales = (1.0, 64.0, 1e-30, 1e15)
    found = [
        answer(snapshot, rows[5] * np.float32(s), everything, SearchOptions(5)) for s in scales
    ]
    for one in found:
        assert [hit.photo_id for hit in one.hits] == [hit.photo_id for hit in found[0].hits]
        assert one.certificate == "bound"
    nothing = answer(snapshot, np.zeros(DIMENSION, np.float32), everything, SearchOptions(5))
    assert nothing.hits == ()


def test_rows_further_apart_than_a_look_are_all_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pieces of the scan end anywhere in the chunks."""
    from services.search import int8_search

    monkeypatch.setattr(int8_search, "BUDGET_CHECK_BYTES", 7 * DIMENSION)
    rows = places(4, 100, DIMENSION)
    everything = np.ones(100, bool)
    for number in (0, 6, 7, 50, 99):
        found = answer(snapshot_of(rows, by="int8"), rows[number], everything, SearchOptions(5))
        assert_best(hits_of(found), dict(brute_force(rows, rows[number], len(rows), everything)), 5)


def test_dense_mode_compares_every_row() -> None:
    rows = places(4, 150, DIMENSION)
    everything = np.ones(150, bool)
    found = answer(
        snapshot_of(rows, by="int8"), rows[0], everything, SearchOptions(9, mode=Mode.DENSE)
    )
    assert found.certificate == "exhaustive"
    assert_best(hits_of(found), dict(brute_force(rows, rows[0], len(rows), everything)), 9)


def test_statistical_search_is_not_used_where_no_error_is_allowed() -> None:
    """Sign codes alone answer `auto`, never `deterministic`."""
    rows = places(5, 400)
    everything = np.ones(400, bool)
    snapshot = snapshot_of(rows, by="signs")
    for mode, certificate in ((Mode.AUTO, "statistical"), (Mode.DETERMINISTIC, "exhaustive")):
        found = answer(snapshot, rows[0], everything, SearchOptions(3, mode=mode))
        assert found.certificate == certificate
        assert_best(hits_of(found), dict(brute_force(rows, rows[0], len(rows), everything)), 3)
    both = replace(
        snapshot,
        chunks=tuple(
            replace(chunk, int8=other.int8)
            for chunk, other in zip(
                snapshot.chunks, snapshot_of(rows, by="int8").chunks, strict=True
            )
        ),
    )
    found = answer(both, rows[0], everything, SearchOptions(3, mode=Mode.DETERMINISTIC))
    assert found.certificate == "bound"
    assert_best(hits_of(found), dict(brute_force(rows, rows[0], len(rows), everything)), 3)
    found = answer(both, rows[0], everything, SearchOptions(3))
    assert found.certificate == "statistical", "a glance at the signs reads less"


@pytest.mark.parametrize(
    ("selected", "k", "dimension", "number_bytes", "worth"),
    [
        (100_000, 10, 512, 4, True),
        (100_000, 10, 512, 2, True),
        (100_000, 90_000, 512, 4, False),
        (60, 10, 512, 4, True),
        (60, 10, 512, 2, False),
        (20, 10, 512, 4, False),
        (100_000, 10, 12, 4, False),  # 64 bytes and the figures against 48
        (10_000, 10, 98_304, 4, True),
        (10_000, 10, 98_304, 2, True),
    ],
)
def test_int8_codes_are_used_where_they_are_less_to_read(
    monkeypatch: pytest.MonkeyPatch,
    selected: int,
    k: int,
    dimension: int,
    number_bytes: int,
    worth: bool,
) -> None:
    monkeypatch.undo()
    assert int8_codes_pay_off(selected, k, dimension, number_bytes * dimension) == worth


@pytest.mark.parametrize("most_rows", [0, 1, 5, 12])
def test_search_that_gives_up_says_so_and_of_how_many_hits_it_is_certain(most_rows: int) -> None:
    rows = places(8, 400, DIMENSION)
    everything = np.ones(400, bool)
    query = rows[3] + np.float32(0.5) * places(19, 1, DIMENSION)[0]
    question = SearchOptions(20, most_rows=most_rows)
    found = answer(snapshot_of(rows, by="int8"), query, everything, question)
    assert found.certificate == "none"
    assert found.rows_reranked <= most_rows
    exact = dict(brute_force(rows, query, 400, everything))
    assert found.certified_k <= len(found.hits)
    assert_best(hits_of(found)[: found.certified_k], exact, found.certified_k)


def test_search_that_runs_out_of_time_says_so() -> None:
    rows = places(8, 400, DIMENSION)
    question = SearchOptions(20, most_seconds=1e-9)
    found = answer(snapshot_of(rows, by="int8"), rows[3], np.ones(400, bool), question)
    assert found.certificate == "none"
    assert found.certified_k <= len(found.hits) < 20


def test_nothing_that_matters_left_out_is_no_giving_up() -> None:
    rows = places(8, 400, DIMENSION)
    question = SearchOptions(1, 0.999, most_rows=400)
    found = answer(snapshot_of(rows, by="int8"), rows[3], np.ones(400, bool), question)
    assert found.certificate == "bound"
    assert [hit.photo_id for hit in found.hits] == [photo(3)]
