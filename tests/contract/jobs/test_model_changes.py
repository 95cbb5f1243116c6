"""Jobs that create a generation: one at a time in each map, cancellation, activation."""

from __future__ import annotations

import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any
from uuid import UUID

import pytest
from sqlalchemy import event, select

from services.steward.tasks.model_changes import advance_model_changes
from services.steward.tasks.reindex_jobs import cancel_jobs_of_abandoned_generations
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation, GenerationState
from shared.catalog.jobs import MODEL_CHANGE_JOBS, Priority, WaitingFor, get_job
from shared.catalog.maps import lock_map
from shared.errors import Conflict
from shared.jobs import InProcessWakeups, Job, JobKind, JobState
from shared.jobs.leases import lock_leased_jobs
from shared.jobs.model_changes import (
    cancel_model_change,
    create_generation,
    get_unfinished_model_change,
    start_model_change,
)
from shared.storage import FolderStore
from tests.contract.jobs.jobs import queue, token_of
from tests.support.catalog_rows import (
    add_chunk,
    add_generation,
    add_map,
    add_photo,
    is_lock_awaited,
    read_job,
    states,
    take,
)
from tests.support.threads import at_once


def test_a_second_model_change_is_refused_and_names_the_first(
    catalog: Catalog, map_id: UUID
) -> None:
    with catalog.write() as session:
        other = add_map(session, "other").id
        first = start_model_change(session, map_id, JobKind.FIT, {"seed": 0}).id
        start_model_change(session, other, JobKind.FIT, {"seed": 0})  # each map has its own
    for kind in MODEL_CHANGE_JOBS:
        with (
            pytest.raises(Conflict, match=rf"{first}/cancel\?map=") as refused,
            catalog.write() as session,
        ):
            start_model_change(session, map_id, kind, {})
        assert refused.value.code == "model_change_running"
        assert refused.value.extra == {"job_id": str(first)}
    with catalog.write() as session:
        cancel_model_change(session, get_job(session, map_id, first, lock=True))
        assert get_unfinished_model_change(session, map_id) is None
        start_model_change(session, map_id, JobKind.IMPORT, {})


def test_one_of_two_concurrent_model_changes_is_accepted(catalog: Catalog, map_id: UUID) -> None:
    def start() -> UUID | str:
        try:
            with catalog.write() as session:
                return start_model_change(session, map_id, JobKind.FIT, {}).id
        except Conflict as error:
            return str(error.extra["job_id"])

    outcomes = at_once(*[start] * 4)
    (winner,) = [outcome for outcome in outcomes if isinstance(outcome, UUID)]
    assert outcomes.count(str(winner)) == 3


def test_the_first_generation_of_a_map_is_active_at_once_and_outlives_its_cancelled_job(
    catalog: Catalog, map_id: UUID
) -> None:
    job_id = _begin(catalog, map_id)
    with catalog.read() as session:
        generation = session.scalars(select(Generation)).one()
    assert generation.state == GenerationState.ACTIVE
    assert generation.activated_at is not None
    job = read_job(catalog, job_id)
    assert (job.state, job.waiting_for) == (JobState.RUNNING, WaitingFor.DESCRIPTORS)
    assert (job.generation_id, job.lease_token) == (generation.id, None)
    with catalog.write() as session:
        cancel_model_change(session, get_job(session, map_id, job_id, lock=True))
    with catalog.read() as session:
        assert session.scalars(select(Generation.state)).all() == [GenerationState.ACTIVE]


def test_the_jobs_of_a_cancelled_model_change_are_cancelled_in_small_transactions(
    catalog: Catalog, map_id: UUID, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("shared.jobs.transitions", "services.steward.tasks.reindex_jobs"):
        monkeypatch.setattr(f"{module}.CANCELLED_PER_TRANSACTION", 2)
    with catalog.write() as session:
        add_generation(session, map_id)
    job_id = _begin(catalog, map_id)
    building = read_job(catalog, job_id).generation_id
    reindex = queue(catalog, map_id, 7, kind=JobKind.REINDEX, generation_id=building)
    uploads = queue(catalog, map_id)
    with updated_rows(catalog) as updated:
        with catalog.write() as session:
            cancel_model_change(session, get_job(session, map_id, job_id, lock=True))
        assert states(catalog, reindex).count(JobState.CANCELLED) == 2
        cancel_jobs_of_abandoned_generations(catalog)
    assert states(catalog, reindex) == [JobState.CANCELLED] * 7
    assert states(catalog, uploads) == [JobState.QUEUED]
    assert max(updated) == 2


@contextmanager
def updated_rows(catalog: Catalog) -> Iterator[list[int]]:
    """Yield a list to which the number of rows of each UPDATE of the jobs is added."""
    counts: list[int] = []

    def count(_connection: Any, cursor: Any, statement: str, *_: Any) -> None:
        if statement.startswith("UPDATE jobs"):
            counts.append(cursor.rowcount)

    event.listen(catalog.engine, "after_cursor_execute", count)
    yield counts
    event.remove(catalog.engine, "after_cursor_execute", count)


@pytest.mark.databases("postgresql")
def test_queueing_photos_locks_the_map_before_the_job_as_the_activation_does(
    catalog: Catalog, store: FolderStore, map_id: UUID
) -> None:
    """PostgreSQL only. In two orders, two stewards would wait for each other."""
    with catalog.write() as session:
        active = add_generation(session, map_id).id
        photo_id = add_photo(session, map_id).id
    add_chunk(catalog, store, active, [photo_id])
    job_id = _begin(catalog, map_id)
    with ThreadPoolExecutor(1) as pool:
        with catalog.write() as session:
            lock_map(session, map_id)
            queueing = pool.submit(advance_model_changes, catalog, InProcessWakeups(), {})
            while not is_lock_awaited(catalog):
                assert not queueing.done()
                time.sleep(0.01)
            own = select(Job.id).where(Job.id == job_id).with_for_update(nowait=True)
            assert session.scalar(own) == job_id
        queueing.result()
    with catalog.read() as session:
        queued = session.scalars(select(Job.photo_id).where(Job.kind == JobKind.REINDEX)).all()
    assert queued == [photo_id]


def _begin(catalog: Catalog, map_id: UUID) -> UUID:
    """A model change up to where it waits for descriptors; its job."""
    with catalog.write() as session:
        template = add_generation(session, map_id, GenerationState.RETIRED)
        job_id = start_model_change(session, map_id, JobKind.FIT, {}).id
    jobs = take(catalog, least_priority=Priority.MODEL_CHANGE)
    while jobs[0].id != job_id:
        jobs = take(catalog, least_priority=Priority.MODEL_CHANGE)
    columns = ("extractor", "spec", "spec_fingerprint", "dimension", "model_id")
    with catalog.write() as session:
        (mine,) = lock_leased_jobs(session, token_of(jobs), jobs)
        create_generation(session, mine, **{name: getattr(template, name) for name in columns})
        session.delete(session.get_one(Generation, template.id))
    return job_id
