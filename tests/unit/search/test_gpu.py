"""Search on a device: PyTorch's CPU stands for a GPU. The same answers as brute force, whatever
lies on the device, and the CPU's way where it fails."""

from __future__ import annotations

import logging
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings

from services.search import executor, gpu
from services.search import residency as residency_module
from services.search.executor import SearchOptions
from services.search.gpu import GpuRows
from services.search.residency import open_search_gpu
from services.search.snapshot import Snapshot
from shared.errors import Misconfigured
from shared.search_api.protocol import Mode
from tests.unit.search.search_rows import (
    Case,
    answer,
    assert_best,
    brute_force,
    cases,
    hits_of,
    places,
    snapshot_of,
)

pytestmark = pytest.mark.numerics

DIMENSION = 512
ROWS = places(6, 90, DIMENSION)
QUERY = ROWS[3]
EVERYTHING = np.ones(90, bool)


@pytest.fixture(autouse=True)
def always_worth_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(executor, "sign_codes_pay_off", lambda selected, k: True)


def gpu_rows() -> GpuRows:
    return GpuRows(torch.device("cpu"))


def on_device(snapshot: Snapshot, rows: GpuRows | None = None) -> Snapshot:
    rows = rows or gpu_rows()
    rows.load(snapshot)
    assert rows.status().generations == (snapshot.generation_id,)
    return replace(snapshot, gpu=rows)


@settings(max_examples=25, deadline=None)
@given(case=cases(DIMENSION))
def test_answers_equal_brute_force_with_order_and_ties(case: Case) -> None:
    pieces = min(case.pieces, len(case.rows))
    snapshot = on_device(snapshot_of(case.rows, pieces, coded=False))
    found = answer(snapshot, case.query, case.selected, SearchOptions(case.k, case.min_score))
    assert_best(hits_of(found), case.exact, case.k)
    if case.selected.any() and case.query.any():
        assert found.certificate == "exhaustive"
        assert found.rows_scanned == int(case.selected.sum())


@pytest.mark.parametrize("dimension", [3, 100, 7168, 20_000])
@pytest.mark.parametrize("row_type", [np.float16, np.float32])
def test_rows_of_any_length_and_type_are_ranked_as_they_are_stored(
    dimension: int, row_type: type[np.floating[Any]]
) -> None:
    rows = places(3, 40, dimension).astype(row_type)
    rows[0], rows[0, 0] = 0, 1
    rows[1] = 1 / math.sqrt(dimension)
    rows[2] = 0
    everything = np.ones(40, bool)
    snapshot = on_device(snapshot_of(rows, 2, coded=False))
    for query in (rows[0], rows[1], rows[5] * np.float32(1e-4), -rows[9]):
        found = answer(snapshot, query.astype(np.float32), everything, SearchOptions(7))
        exact = dict(brute_force(rows, query.astype(np.float32), 40, everything))
        assert_best(hits_of(found), exact, 7)


def test_rows_that_are_converted_in_parts_give_the_same_answer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rows = places(5, 120, DIMENSION)
    snapshot, everything = on_device(snapshot_of(rows, coded=False)), np.ones(120, bool)
    whole = answer(snapshot, rows[7], everything, SearchOptions(20))
    monkeypatch.setattr(gpu, "CONVERTED_NUMBERS", 7 * DIMENSION)
    assert answer(snapshot, rows[7], everything, SearchOptions(20)) == whole


def is_loaded(snapshot: Snapshot, rows: GpuRows) -> bool:
    return rows.find_candidates(snapshot, QUERY, EVERYTHING, 1, None) is not None


def test_only_new_chunks_are_copied_to_the_device(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = snapshot_of(ROWS, 3, coded=False)
    first = replace(whole, chunks=whole.chunks[:2])
    copied: list[int] = []
    real = torch.tensor

    def copy(data: Any, **options: Any) -> torch.Tensor:
        copied.append(len(data))
        return real(data, **options)

    rows = gpu_rows()
    with monkeypatch.context() as patched:
        patched.setattr(torch, "tensor", copy)
        rows.load(first)
        rows.load(whole, max_bytes=0)
        assert copied == [30, 30], "many rows are copied while no query waits"
        rows.load(whole)
    assert copied == [30, 30, 30]
    found = answer(replace(whole, gpu=rows), QUERY, EVERYTHING, SearchOptions(5))
    assert hits_of(found) == brute_force(ROWS, QUERY, 5, EVERYTHING)


def test_memory_of_merged_chunks_and_of_ended_or_coded_generations_is_freed() -> None:
    whole, rows = snapshot_of(ROWS, 3, coded=False), gpu_rows()
    rows.load(whole)
    assert rows.status().resident_bytes == ROWS.nbytes
    rows.load(replace(whole, chunks=whole.chunks[1:]))
    assert rows.status().resident_bytes == ROWS.nbytes * 2 // 3
    assert not is_loaded(whole, rows)
    rows.release([whole.generation_id])
    assert rows.status().resident_bytes == 0
    rows.load(whole)
    assert rows.status().generations == (whole.generation_id,)
    rows.load(replace(snapshot_of(ROWS), generation_id=whole.generation_id))
    assert rows.status().generations == (), "it has sign codes now"


@pytest.mark.parametrize("retry_seconds", [0.0, gpu.RETRY_SECONDS])
def test_rows_that_do_not_fit_are_searched_by_the_cpu_and_tried_again_later(
    monkeypatch: pytest.MonkeyPatch, retry_seconds: float
) -> None:
    monkeypatch.setattr(gpu, "RETRY_SECONDS", retry_seconds)
    snapshot, rows = snapshot_of(ROWS, 3, coded=False), gpu_rows()
    with monkeypatch.context() as patched:
        patched.setattr(GpuRows, "free_bytes", lambda _: 1000.0)
        rows.load(snapshot)
    assert not is_loaded(snapshot, rows)
    rows.load(snapshot)
    assert is_loaded(snapshot, rows) == (retry_seconds == 0), "not at every look"


def out_of_memory(*_: object, **__: object) -> Any:
    raise torch.OutOfMemoryError("CUDA out of memory")


@pytest.mark.parametrize("failing", ["query", "load"])
def test_device_out_of_memory_leaves_the_generation_to_the_cpu_for_a_while(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, failing: str
) -> None:
    rows = gpu_rows()
    snapshot = replace(snapshot_of(ROWS, coded=False), gpu=rows)
    if failing == "query":
        rows.load(snapshot)
    with monkeypatch.context() as patched, caplog.at_level(logging.ERROR):
        patched.setattr(torch, "tensor", out_of_memory)
        rows.load(snapshot)
        found = answer(snapshot, QUERY, EVERYTHING, SearchOptions(7))
    assert hits_of(found) == brute_force(ROWS, QUERY, 7, EVERYTHING)
    assert "searched by the CPU for now: CUDA out of memory" in caplog.text
    status = rows.status()
    assert (status.failure, status.generations) == ("CUDA out of memory", ())
    rows.release([snapshot.generation_id])
    rows.load(snapshot)
    status = rows.status()
    assert (status.failure, status.generations) == (None, (snapshot.generation_id,))


def test_dense_mode_never_asks_the_device(monkeypatch: pytest.MonkeyPatch) -> None:
    snapshot = on_device(snapshot_of(ROWS, coded=False))
    monkeypatch.setattr(GpuRows, "find_candidates", out_of_memory)
    answer(snapshot, QUERY, EVERYTHING, SearchOptions(7, mode=Mode.DENSE))


@pytest.mark.parametrize("sees_driver", [False, True])
def test_without_a_gpu_or_pytorch_search_uses_the_cpu_or_says_what_is_missing(
    monkeypatch: pytest.MonkeyPatch, sees_driver: bool, tmp_path: Path
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    driver = tmp_path / "driver"
    if sees_driver:
        driver.touch()
    monkeypatch.setattr(residency_module, "DRIVER_PATHS", (driver,))
    assert open_search_gpu("auto") is None
    assert open_search_gpu("cpu") is None
    with pytest.raises(Misconfigured, match="no CUDA device"):
        open_search_gpu("cuda")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert open_search_gpu("auto") is None
    with pytest.raises(Misconfigured, match="search-gpu"):
        open_search_gpu("cuda")
