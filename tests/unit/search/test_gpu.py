"""Search on a device: PyTorch's CPU stands for a GPU. The same answers as brute force, whatever
lies on the device, and the CPU's way where it fails."""

from __future__ import annotations

import gc
import logging
import math
import weakref
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
from services.search.gpu import GpuDevice, GpuError, GpuSnapshot
from services.search.residency import GpuResidency, open_search_device
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


@pytest.fixture(autouse=True)
def always_worth_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(executor, "sign_codes_pay_off", lambda selected, k: True)


def cpu_device() -> GpuDevice:
    return GpuDevice(torch.device("cpu"))


def on_device(snapshot: Snapshot) -> Snapshot:
    found = GpuResidency(cpu_device()).update(snapshot)
    assert found.gpu_snapshot is not None
    return found


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


def test_only_new_chunks_are_copied_to_the_device(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = places(6, 90, DIMENSION)
    whole = snapshot_of(rows, 3, coded=False)
    first = replace(whole, chunks=whole.chunks[:2])
    residency = GpuResidency(cpu_device())
    old = residency.update(first)
    new = residency.carry_over(whole, old)
    assert old.gpu_snapshot is not None
    assert new.gpu_snapshot is not None
    for chunk_id, there in old.gpu_snapshot.rows.items():
        assert new.gpu_snapshot.rows[chunk_id] is there
    assert len(new.gpu_snapshot.rows) == 3
    found = answer(new, rows[80], np.ones(90, bool), SearchOptions(5))
    assert hits_of(found) == brute_force(rows, rows[80], 5, np.ones(90, bool))
    monkeypatch.setattr(residency_module, "MAX_SYNC_COPY_BYTES", 0)
    assert residency.carry_over(whole, old).gpu_snapshot is None, (
        "many rows are copied while none waits"
    )
    assert residency.needs_update(residency.carry_over(whole, old))


def test_memory_of_a_forgotten_snapshot_and_of_merged_chunks_is_free() -> None:
    whole = snapshot_of(places(6, 90, DIMENSION), 3, coded=False)
    residency = GpuResidency(cpu_device())
    old = residency.update(whole)
    assert old.gpu_snapshot is not None
    resident = weakref.ref(old.gpu_snapshot)
    tensors = [weakref.ref(there) for there in old.gpu_snapshot.rows.values()]
    new = residency.carry_over(replace(whole, chunks=whole.chunks[1:]), old)
    del old
    gc.collect()
    assert [tensor() is None for tensor in tensors] == [True, False, False]
    assert resident() is None
    del new
    gc.collect()
    assert all(tensor() is None for tensor in tensors)


def test_rows_that_do_not_fit_are_searched_by_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(GpuDevice, "free_bytes", lambda _: 1000.0)
    snapshot = snapshot_of(places(6, 90, DIMENSION), 3, coded=False)
    residency = GpuResidency(cpu_device())
    found = residency.update(snapshot)
    assert found.gpu_snapshot is None
    assert not residency.needs_update(found), "it is tried again later, not at every look"


def out_of_memory(*_: object, **__: object) -> Any:
    raise torch.OutOfMemoryError("CUDA out of memory")


def test_device_out_of_memory_in_a_query_leaves_it_to_the_cpu(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    rows = places(6, 90, DIMENSION)
    residency = GpuResidency(cpu_device())
    snapshot = residency.update(snapshot_of(rows, coded=False))
    everything = np.ones(90, bool)
    with monkeypatch.context() as patch, caplog.at_level(logging.ERROR):
        patch.setattr(GpuSnapshot, "_cosines", out_of_memory)
        found = answer(snapshot, rows[3], everything, SearchOptions(7))
    assert hits_of(found) == brute_force(rows, rows[3], 7, everything)
    assert "searched by the CPU: CUDA out of memory" in caplog.text
    (status,) = residency.status([snapshot])
    assert status.failure == "CUDA out of memory"
    assert status.generations == ()
    assert residency.needs_update(snapshot), "what failed is taken from the device"
    without = residency.update(snapshot)
    assert without.gpu_snapshot is None
    assert not residency.needs_update(without), "and tried again after a while"
    monkeypatch.setattr(residency, "_retry_at", {})
    (status,) = residency.status([residency.update(without)])
    assert status.failure is None
    assert status.generations == (snapshot.generation_id,)
    assert status.resident_bytes == 90 * DIMENSION * 4


def test_device_out_of_memory_when_loading_is_reported_and_retried_later(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    snapshot = snapshot_of(places(6, 90, DIMENSION), coded=False)
    residency = GpuResidency(cpu_device())
    with monkeypatch.context() as patch, caplog.at_level(logging.ERROR):
        patch.setattr(torch, "tensor", out_of_memory)
        assert residency.update(snapshot).gpu_snapshot is None
    assert "is searched by the CPU for now: CUDA out of memory" in caplog.text
    (status,) = residency.status([snapshot])
    assert status.failure == "CUDA out of memory"
    assert not residency.needs_update(snapshot)
    monkeypatch.setattr(residency, "_retry_at", {})
    assert residency.needs_update(snapshot)


def test_dense_mode_never_asks_the_device(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = places(6, 90, DIMENSION)
    snapshot = on_device(snapshot_of(rows, coded=False))
    monkeypatch.setattr(GpuSnapshot, "_cosines", out_of_memory)
    answer(snapshot, rows[3], np.ones(90, bool), SearchOptions(7, mode=Mode.DENSE))
    assert snapshot.gpu_snapshot is not None
    assert snapshot.gpu_snapshot.failure is None


def test_device_failures_differ_from_other_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    snapshot = on_device(snapshot_of(places(6, 90, DIMENSION), coded=False))
    assert snapshot.gpu_snapshot is not None
    monkeypatch.setattr(GpuSnapshot, "_cosines", out_of_memory)
    with pytest.raises(GpuError, match="out of memory"):
        snapshot.gpu_snapshot.find_candidates(
            np.ones(DIMENSION, np.float32), np.ones(90, bool), 1, None
        )


@pytest.mark.parametrize("sees_driver", [False, True])
def test_without_a_gpu_search_uses_the_cpu_or_says_what_is_missing(
    monkeypatch: pytest.MonkeyPatch, sees_driver: bool, tmp_path: Path
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    driver = tmp_path / "driver"
    if sees_driver:
        driver.touch()
    monkeypatch.setattr(residency_module, "DRIVER_PATHS", (driver,))
    assert open_search_device("auto") is None
    assert open_search_device("cpu") is None
    with pytest.raises(Misconfigured, match="no CUDA device"):
        open_search_device("cuda")


def test_without_pytorch_search_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert open_search_device("auto") is None
    with pytest.raises(Misconfigured, match="search-gpu"):
        open_search_device("cuda")
