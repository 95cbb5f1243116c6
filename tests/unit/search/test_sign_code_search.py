"""Search by codes against brute force in float64: the same rows, in the same order."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings

from services.search import executor, kernels, sign_code_search
from services.search.chunk_loader import LoadedChunk
from services.search.dense_scan import compile_kernel
from services.search.query_batcher import QueryBatcher
from services.search.sign_code_search import scan_first_level
from services.search.snapshot import Snapshot
from shared.codes.sign_codes import encode_signs
from shared.ids import new_id
from shared.search_api.protocol import SearchResponse
from tests.support.waiting import wait_until
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

DIMENSION = 7168


@pytest.fixture(autouse=True)
def by_codes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(executor, "sign_codes_pay_off", lambda selected, k: True)


@settings(max_examples=20)
@given(case=cases(DIMENSION))
def test_answers_equal_brute_force_with_order_and_ties(case: Case) -> None:
    snapshot = snapshot_of(case.rows, case.pieces)
    found = answer(snapshot, case.query, case.selected, case.k)
    assert_best(hits_of(found), case.exact, case.k)
    if case.selected.any():
        assert found.certificate == "statistical"
        assert found.rows_scanned == int(case.selected.sum())
        assert found.max_z is not None
        assert found.max_z < 5.5


@pytest.mark.parametrize("dimension", [64, 100, 8192, 49_152])
def test_rows_of_any_length_are_searched(dimension: int) -> None:
    rows = places(3, 60, dimension)
    everything = np.ones(60, bool)
    for query in rows[:3]:
        found = answer(snapshot_of(rows), query, everything, 7)
        assert_best(hits_of(found), dict(brute_force(rows, query, len(rows), everything)), 7)
        assert found.certificate == "statistical"


def test_few_rows_are_read_when_the_place_is_in_the_map() -> None:
    rows = places(1, 2000)
    query = rows[77] + np.float32(0.002) * places(9, 1)[0]
    found = answer(snapshot_of(rows), query, np.ones(2000, bool), 1)
    assert found.hits[0].photo_id == photo(77)
    assert found.rows_scanned == 2000
    assert found.rows_reranked < 50


def test_query_of_any_length_gives_the_same_answer() -> None:
    rows = places(2, 100)
    everything = np.ones(100, bool)
    snapshot = snapshot_of(rows)
    found = [answer(snapshot, rows[5] * np.float32(s), everything, 5) for s in (1, 64)]
    assert hits_of(found[0]) == hits_of(found[1])
    nothing = answer(snapshot, np.zeros(DIMENSION, np.float32), everything, 5)
    assert nothing.hits == ()


def test_few_rows_are_compared_without_codes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    rows = places(4, 300)
    searched = np.zeros(300, bool)
    searched[:50] = True
    assert answer(snapshot_of(rows), rows[0], searched, 3).certificate == "exhaustive"
    everything = answer(snapshot_of(rows), rows[0], ~np.zeros(300, bool), 3)
    assert everything.certificate == "statistical"


def test_every_row_is_compared_if_sign_codes_contradict_exact_scores() -> None:
    rows = places(6, 200)
    snapshot = snapshot_of(rows, 1)
    (chunk,) = snapshot.chunks
    assert chunk.codes is not None
    wrong = LoadedChunk(
        chunk.chunk_id, chunk.object_key, chunk.rows, chunk.photos, encode_signs(rows[::-1].copy())
    )
    lying = Snapshot(new_id(), new_id(), 1, (wrong,))
    everything = np.ones(200, bool)
    found = answer(lying, rows[3], everything, 10)
    assert found.certificate == "exhaustive"
    assert_best(hits_of(found), dict(brute_force(rows, rows[3], len(rows), everything)), 10)


def test_queries_that_come_together_get_the_answers_that_they_get_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rows = places(12, 500)
    snapshot = snapshot_of(rows)
    rng = np.random.default_rng(1)
    queries = [rows[row] + np.float32(0.3) * places(row, 1)[0] for row in range(24)]
    requests = [rng.random(500) < rng.choice([1.0, 0.3]) for _ in queries]
    questions = [int(rng.choice([1, 5, 30])) for _ in queries]
    alone = [answer(snapshot, *one) for one in zip(queries, requests, questions, strict=True)]
    glances = QueryBatcher()

    def first_waits(*arguments: Any) -> Any:
        if glances.batches_run == 1:
            wait_until(lambda: glances.queue_length == 23)
        return scan_first_level(*arguments)

    monkeypatch.setattr(sign_code_search, "scan_first_level", first_waits)

    def ask(number: int) -> SearchResponse:
        return executor.execute_query(
            snapshot, queries[number], requests[number], questions[number], glances
        )

    with ThreadPoolExecutor(len(queries)) as threads:
        together = list(threads.map(ask, range(len(queries))))
    assert together == alone
    assert glances.queries_run == 24
    assert glances.batches_run == 2, "the first goes alone, and all others in one round after it"


def test_warm_up_compiles_all_kernels() -> None:
    rows = places(3, 400, 98_304)
    snapshot = snapshot_of(rows)
    sign_code_search.compile_kernels()
    compile_kernel(snapshot)
    loops = [one for one in vars(kernels).values() if hasattr(one, "signatures")]
    before = {loop.py_func.__name__: len(loop.signatures) for loop in loops}
    assert before["hamming_distances"] == 1
    answer(snapshot, rows[0], np.ones(400, bool), 300)
    assert {loop.py_func.__name__: len(loop.signatures) for loop in loops} == before
