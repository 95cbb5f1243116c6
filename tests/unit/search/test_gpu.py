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
from services.search.gpu import GpuDevice, GpuError, GpuQuery, GpuUnsupported
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


def device_with(free_bytes: float = math.inf) -> GpuDevice:
    return GpuDevice(torch.device("cpu"), lambda: free_bytes, 0)


def on_device(snapshot: Snapshot) -> Snapshot:
    found = GpuResidency(device_with()).update(snapshot)
    assert found.gpu_snapshot is not None
    return found


@settings(max_examples=25, deadline=None)
@given(case=cases(DIMENSION))
def test_answers_equal_brute_force_with_order_and_ties(case: Case) -> None:
    pieces = min(case.pieces, len(case.rows))
    snapshot = on_device(snapshot_of(case.rows, pieces, "int8"))
    found = answer(snapshot, case.query, case.selected, SearchOptions(case.k, case.min_score))
    assert_best(hits_of(found), case.exact, case.k)
    if case.selected.any() and case.query.any():
        assert found.certificate == "bound"
        assert found.rows_scanned == int(case.selected.sum())


@pytest.mark.parametrize("dimension", [3, 100, 7168, 20_000])
def test_no_score_is_further_off_than_its_bound(dimension: int) -> None:
    rows = places(3, 40, dimension)
    rows[0], rows[0, 0] = 0, 1
    rows[1] = 1 / math.sqrt(dimension)
    rows[2] = 0
    snapshot = on_device(snapshot_of(rows, 2, "int8"))
    resident = snapshot.gpu_snapshot
    assert resident is not None
    queries = np.stack([rows[0], rows[1], rows[5] * np.float32(1e-20), -rows[9]])
    chunks = list(resident.chunks.values())
    scores, bounds = gpu._score_all_rows(chunks, queries, torch.device("cpu"))
    unit = queries.astype(np.float64)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    errors = np.abs(scores.numpy() - unit @ rows.astype(np.float64).T)
    assert np.all(errors <= bounds.numpy())
    assert bounds.max() < 2e-3


def test_queries_of_a_batch_do_not_see_each_other() -> None:
    rows = places(5, 120, DIMENSION)
    snapshot = on_device(snapshot_of(rows, by="int8"))
    assert snapshot.gpu_snapshot is not None
    rng = np.random.default_rng(1)
    batch = [
        GpuQuery(rows[number], rng.random(120) < 0.7, k, least)
        for number, k, least in ((3, 1, -math.inf), (7, 20, 0.1), (50, 400, -math.inf))
    ]
    together = snapshot.gpu_snapshot.candidates(batch)
    for searched, found in zip(batch, together, strict=True):
        (alone,) = snapshot.gpu_snapshot.candidates([searched])
        np.testing.assert_array_equal(found.rows, alone.rows)
        assert found.floor == pytest.approx(alone.floor, abs=1e-6)
        assert searched.row_mask[found.rows].all()


def test_only_new_chunks_are_copied_to_the_device(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = places(6, 90, DIMENSION)
    whole = snapshot_of(rows, 3, "int8")
    first = replace(whole, chunks=whole.chunks[:2])
    residency = GpuResidency(device_with())
    old = residency.update(first)
    copied: list[int] = []
    make = GpuDevice._copy_as_float16

    def counted(self: GpuDevice, some: Any) -> Any:
        copied.append(len(some))
        return make(self, some)

    monkeypatch.setattr(GpuDevice, "_copy_as_float16", counted)
    new = residency.carry_over(whole, old)
    assert copied == [30]
    found = answer(new, rows[80], np.ones(90, bool), SearchOptions(5))
    assert hits_of(found) == brute_force(rows, rows[80], 5, np.ones(90, bool))
    monkeypatch.setattr(residency_module, "MAX_SYNC_COPY_BYTES", 0)
    assert residency.carry_over(whole, old).gpu_snapshot is None, (
        "many rows are copied while none waits"
    )
    assert residency.needs_update(residency.carry_over(whole, old))


def test_memory_of_a_forgotten_snapshot_and_of_merged_chunks_is_free() -> None:
    whole = snapshot_of(places(6, 90, DIMENSION), 3, "int8")
    residency = GpuResidency(device_with())
    old = residency.update(whole)
    assert old.gpu_snapshot is not None
    resident = weakref.ref(old.gpu_snapshot)
    tensors = [weakref.ref(chunk.numbers) for chunk in old.gpu_snapshot.chunks.values()]
    new = residency.carry_over(replace(whole, chunks=whole.chunks[1:]), old)
    del old
    gc.collect()
    assert [tensor() is None for tensor in tensors] == [True, False, False]
    assert resident() is None
    del new
    gc.collect()
    assert all(tensor() is None for tensor in tensors)


def test_rows_that_do_not_fit_are_searched_by_the_cpu() -> None:
    snapshot = snapshot_of(places(6, 90, DIMENSION), 3, "int8")
    residency = GpuResidency(device_with(1000))
    found = residency.update(snapshot)
    assert found.gpu_snapshot is None
    assert not residency.needs_update(found), "it is tried again later, not at every look"


def out_of_memory(*_: object, **__: object) -> Any:
    raise torch.OutOfMemoryError("CUDA out of memory")


def test_device_out_of_memory_in_a_query_leaves_it_to_the_cpu(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    rows = places(6, 90, DIMENSION)
    residency = GpuResidency(device_with())
    snapshot = residency.update(snapshot_of(rows, by="int8"))
    everything = np.ones(90, bool)
    with monkeypatch.context() as patch, caplog.at_level(logging.ERROR):
        patch.setattr(gpu, "_score_all_rows", out_of_memory)
        found = answer(snapshot, rows[3], everything, SearchOptions(7))
    assert hits_of(found) == brute_force(rows, rows[3], 7, everything)
    assert "searched by the CPU: CUDA out of memory" in caplog.text
    (status,) = residency.status([snapshot])
    assert status.failure == "CUDA out of memory"
    assert status.generations == {}
    assert residency.needs_update(snapshot), "what failed is taken from the device"
    without = residency.update(snapshot)
    assert without.gpu_snapshot is None
    assert not residency.needs_update(without), "and tried again after a while"
    monkeypatch.setattr(residency, "_retry_at", {})
    (status,) = residency.status([residency.update(without)])
    assert status.failure is None
    assert status.generations == {snapshot.generation_id: "float16"}
    assert status.resident_bytes >= 90 * DIMENSION * 2


def test_device_out_of_memory_when_loading_is_reported_and_retried_later(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    snapshot = snapshot_of(places(6, 90, DIMENSION), by="int8")
    residency = GpuResidency(device_with())
    with monkeypatch.context() as patch, caplog.at_level(logging.ERROR):
        patch.setattr(GpuDevice, "_copy_as_float16", out_of_memory)
        assert residency.update(snapshot).gpu_snapshot is None
    assert "is searched by the CPU for now: CUDA out of memory" in caplog.text
    (status,) = residency.status([snapshot])
    assert status.failure == "CUDA out of memory"
    assert not residency.needs_update(snapshot)
    monkeypatch.setattr(residency, "_retry_at", {})
    assert residency.needs_update(snapshot)


def test_dense_mode_never_asks_the_device(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = places(6, 90, DIMENSION)
    snapshot = on_device(snapshot_of(rows, by="int8"))
    monkeypatch.setattr(gpu, "_score_all_rows", out_of_memory)
    found = answer(snapshot, rows[3], np.ones(90, bool), SearchOptions(7, mode=Mode.DENSE))
    assert found.certificate == "exhaustive"


def test_device_that_adds_up_carelessly_is_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    device_with().self_test()
    exact = gpu._float16_products

    def in_float16(chunk: Any, columns: Any) -> Any:
        return exact(chunk, columns).half().double()

    monkeypatch.setattr(gpu, "_float16_products", in_float16)
    with pytest.raises(GpuUnsupported, match="less precisely"):
        device_with().self_test()


def test_device_failures_differ_from_other_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    snapshot = on_device(snapshot_of(places(6, 90, DIMENSION), by="int8"))
    assert snapshot.gpu_snapshot is not None
    monkeypatch.setattr(gpu, "_score_all_rows", out_of_memory)
    with pytest.raises(GpuError, match="out of memory"):
        snapshot.gpu_snapshot.candidates(
            [GpuQuery(np.ones(DIMENSION, np.float32), np.ones(90, bool), 1, -math.inf)]
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
