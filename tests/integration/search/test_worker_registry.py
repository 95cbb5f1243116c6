"""Search workers in the catalog, and the switch that waits for them."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import BinaryIO
from uuid import UUID

import pytest
from sqlalchemy import select, update

from services.search.worker import SearchWorker
from services.steward.tasks.model_changes import SLOW_LOAD_SECONDS
from shared.catalog.database.base import db_now_plus
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation, GenerationState
from shared.catalog.jobs import WaitingFor
from shared.catalog.maps import Map
from shared.catalog.processes import (
    PROCESS_TIMEOUT_SECONDS,
    RegisteredProcess,
    list_lagging_search_workers,
    process_heartbeat,
    upsert_process,
)
from shared.config.settings import Settings
from shared.ids import new_id
from shared.integrity.verify import repair_descriptors, verify_store
from shared.jobs import InProcessWakeups, JobState
from shared.search_api.protocol import SearchRequest
from shared.storage import FolderStore
from shared.storage.chunks import encode_rows
from shared.storage.keys import QUERIES
from tests.integration.harness import Harness
from tests.support.photos import photo_bytes
from tests.support.waiting import wait_until

pytestmark = pytest.mark.databases("postgresql")

PHOTOS = 5
WAIT_SECONDS = 30.0


class HaltingStore(FolderStore):
    """Keeps whoever reads a chunk waiting until it is let go."""

    def __init__(self, folder: FolderStore) -> None:
        super().__init__(folder.root, exclusive=False)
        self.go_on = threading.Event()
        self.reached = threading.Event()

    def open(self, key: str) -> BinaryIO:
        if key.startswith("chunks/"):
            self.reached.set()
            assert self.go_on.wait(WAIT_SECONDS)
        return super().open(key)


@dataclass(slots=True)
class Registered:
    """A search worker with its entry, which the test runs step by step."""

    catalog: Catalog
    worker: SearchWorker
    name: str
    id: UUID = field(default_factory=new_id)

    def report(self) -> None:
        with self.catalog.write() as session:
            upsert_process(session, self.id, "search", self.name, self.worker.state())

    def catch_up(self) -> None:
        self.worker.sync()
        self.report()


Register = Callable[..., Registered]


@pytest.fixture
def register(catalog: Catalog, store: FolderStore, settings: Settings) -> Register:
    """A worker that is alive and has loaded what there is."""

    def make(name: str, store: FolderStore = store) -> Registered:
        made = Registered(catalog, SearchWorker(catalog, store, settings), name)
        made.report()
        return made

    return make


@pytest.fixture
def fitted(vlads: Harness) -> Harness:
    """A map with a vocabulary and PHOTOS described photos."""
    vlads.upload(*range(PHOTOS))
    assert vlads.fit().state == JobState.SUCCEEDED
    return vlads


def complete(harness: Harness) -> tuple[UUID, UUID]:
    """A model change up to where all photos are described; its job and its generation."""
    job_id, generation_id = harness.build(seed=1)
    for _ in range(3):
        harness.advance()
        harness.drain()
    harness.advance()
    return job_id, generation_id


def entries(catalog: Catalog) -> list[RegisteredProcess]:
    with catalog.read() as session:
        return list(session.scalars(select(RegisteredProcess).order_by(RegisteredProcess.name)))


def age(catalog: Catalog, name: str, seconds: float) -> None:
    """Set the age of the worker's heartbeat."""
    with catalog.write() as session:
        session.execute(
            update(RegisteredProcess)
            .where(RegisteredProcess.name == name)
            .values(seen_at=db_now_plus(-seconds))
            .execution_options(synchronize_session=False)
        )


def found(registered: Registered, harness: Harness, generation: Generation) -> set[UUID]:
    """The photos that the worker answers for the generation."""
    key = f"{QUERIES}{generation.id}.npy"
    row = next(iter(harness.rows(generation.id).values()))
    harness.store.put(key, encode_rows(row[None]))
    with harness.catalog.read() as session:
        version = session.get_one(Map, harness.map_id).version
    request = SearchRequest(
        generation_id=generation.id,
        object_key=key,
        row=0,
        min_version=version,
        k=100,
    )
    return {hit.photo_id for hit in registered.worker.search(request).hits}


# --- the switch ------------------------------------------------------------------------------


def test_a_generation_is_switched_in_once_the_slow_worker_has_loaded_it_too(
    fitted: Harness, register: Register, store: FolderStore
) -> None:
    slow_store = HaltingStore(store)
    slow_store.go_on.set()
    quick, slow = register("quick"), register("slow", store=slow_store)
    quick.catch_up()
    slow.catch_up()
    old = fitted.active()
    slow_store.go_on.clear()
    slow_store.reached.clear()

    job_id, new_id = complete(fitted)
    quick.catch_up()
    loading = threading.Thread(target=slow.worker.sync)
    loading.start()
    try:
        assert slow_store.reached.wait(WAIT_SECONDS), "it does not load what is built"
        fitted.delete(next(iter(found(quick, fitted, old))))  # a change that both have to see
        for _ in range(3):
            slow.report()
            fitted.advance()
            job = fitted.job(job_id)
            assert (job.waiting_for, job.stage) == (WaitingFor.SEARCH, "load")
            assert job.progress_done < job.progress_total
            assert fitted.active().id == old.id
            for worker in (quick, slow):  # loading one generation does not hold up another
                assert len(found(worker, fitted, old)) == PHOTOS - 1
    finally:
        slow_store.go_on.set()
        loading.join()
    fitted.advance()
    assert fitted.active().id == old.id, "it has loaded, and has not reported it yet"
    slow.report()
    fitted.advance()
    job = fitted.job(job_id)
    assert (job.state, job.waiting_for, job.awaited) == (JobState.SUCCEEDED, None, None)
    assert fitted.active().id == new_id
    for worker in (quick, slow):
        assert len(found(worker, fitted, fitted.active())) == PHOTOS - 1


def test_a_switch_does_not_wait_for_a_dead_search_worker(
    fitted: Harness, register: Register, catalog: Catalog
) -> None:
    living, dying = register("living"), register("dying")
    job_id, new_id = complete(fitted)
    living.catch_up()
    fitted.advance()
    assert fitted.job(job_id).waiting_for == WaitingFor.SEARCH
    age(catalog, "dying", PROCESS_TIMEOUT_SECONDS - 2)
    fitted.advance()
    assert fitted.job(job_id).waiting_for == WaitingFor.SEARCH, "it may only have paused"
    age(catalog, "dying", PROCESS_TIMEOUT_SECONDS + 1)
    fitted.advance()
    assert fitted.active().id == new_id
    assert dying.worker.status().versions == {}


def test_a_switch_waits_for_a_live_search_worker_that_has_not_loaded_and_names_it(
    fitted: Harness, register: Register, catalog: Catalog, caplog: pytest.LogCaptureFixture
) -> None:
    register("stuck-b")
    register("stuck-a")
    job_id, new_id = complete(fitted)
    assert fitted.job(job_id).awaited is None, "not yet: loading takes its time"
    with catalog.write() as session:
        session.get_one(Generation, new_id).complete_at = session.scalar(
            select(db_now_plus(-SLOW_LOAD_SECONDS - 1))
        )
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            fitted.advance()
    job = fitted.job(job_id)
    assert (job.waiting_for, job.awaited) == (WaitingFor.SEARCH, ["stuck-a", "stuck-b"])
    assert fitted.generation(new_id).state == GenerationState.BUILDING
    messages = [record.message for record in caplog.records if "stuck-a, stuck-b" in record.message]
    assert len(messages) == 1, "once, not at every look"
    fitted.cancel(job_id)
    assert (fitted.job(job_id).state, fitted.job(job_id).awaited) == (JobState.CANCELLED, None)


@pytest.mark.parametrize("damage", ["truncated", "gone"])
def test_a_damaged_chunk_of_what_is_built_is_repaired_and_then_switched_in(
    fitted: Harness, register: Register, damage: str
) -> None:
    worker = register("worker")
    job_id, new_id = complete(fitted)
    key = next(k for k in fitted.keys(f"chunks/{new_id}/") if k.endswith(".npy"))
    whole = fitted.store.get(key)
    if damage == "gone":
        fitted.store.delete(key)
    else:
        fitted.store.put(key, whole[:-1])
    worker.catch_up()
    fitted.advance()
    assert fitted.job(job_id).waiting_for == WaitingFor.SEARCH

    report = verify_store(fitted.catalog, fitted.store, originals=False)
    assert repair_descriptors(fitted.catalog, InProcessWakeups(), report) > 0
    fitted.advance()
    assert fitted.job(job_id).waiting_for == WaitingFor.DESCRIPTORS
    fitted.drain()
    fitted.advance()
    assert fitted.active().id != new_id, "search has not loaded the rows that were made again"
    worker.catch_up()
    fitted.advance()
    assert fitted.job(job_id).state == JobState.SUCCEEDED
    assert len(found(worker, fitted, fitted.active())) == PHOTOS


def test_a_photo_that_comes_while_search_loads_is_described_before_the_switch(
    fitted: Harness, register: Register
) -> None:
    worker = register("worker")
    job_id, new_id = complete(fitted)
    assert fitted.job(job_id).waiting_for == WaitingFor.SEARCH
    fitted.upload_bytes(photo_bytes(99))
    fitted.drain()
    fitted.advance()
    assert fitted.job(job_id).waiting_for == WaitingFor.DESCRIPTORS
    worker.catch_up()  # at the version at which it was complete for the first time, or later
    fitted.drain()
    fitted.advance()
    assert fitted.active().id == new_id
    assert fitted.job(job_id).state == JobState.SUCCEEDED
    assert len(found(worker, fitted, fitted.active())) == PHOTOS + 1


# --- the entries -----------------------------------------------------------------------------


def test_a_search_worker_registers_what_it_loads_and_unregisters_in_the_end(
    fitted: Harness, register: Register, catalog: Catalog
) -> None:
    worker, active = register("worker").worker, fitted.active().id

    def registered() -> bool:
        with catalog.read() as session:
            return list_lagging_search_workers(session, active, 1) == ["worker"]

    with process_heartbeat(catalog, "search", worker.state):
        wait_until(lambda: len(entries(catalog)) == 2)
        worker.sync()
        wait_until(registered)
    assert [entry.name for entry in entries(catalog)] == ["worker"]
