"""Waiting for jobs: many requests share one look at the table, and none is answered too early."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path
from uuid import UUID

import pytest
from sqlalchemy.exc import OperationalError

from services.gateway import dependencies
from services.gateway.dependencies import Change, JobNotifier, WatchedState
from shared.catalog.database.schema import migrate
from shared.catalog.database.session import Catalog
from shared.ids import new_id
from shared.jobs import Job, JobState
from tests.support.catalog_rows import add_job, add_map, set_columns

LONG = 30.0


@pytest.fixture
def catalog(tmp_path: Path) -> Catalog:
    made = Catalog(f"sqlite:///{tmp_path / 'catalog.sqlite'}")
    migrate(made)
    return made


@pytest.fixture
def jobs(catalog: Catalog) -> list[UUID]:
    with catalog.write() as session:
        map_id = add_map(session).id
        return [add_job(session, map_id).id for _ in range(3)]


async def started(*waits: asyncio.Task[None]) -> None:
    """Returns when they have looked at least once."""
    await asyncio.sleep(5 * dependencies.NOTIFIER_POLL_SECONDS)
    assert not any(wait.done() for wait in waits)


def test_each_waits_until_its_own_job_has_ended(catalog: Catalog, jobs: list[UUID]) -> None:
    async def scenario() -> None:
        watch = JobNotifier(catalog)
        waits = [asyncio.create_task(watch.wait_until_finished(job, LONG)) for job in jobs]
        await started(*waits)
        for job, wait in zip(jobs, waits, strict=True):
            assert not wait.done()
            set_columns(catalog, job, state=JobState.FAILED)
            await asyncio.wait_for(wait, LONG)

    asyncio.run(scenario())


def test_one_slow_look_does_not_hold_up_the_next_ones(
    catalog: Catalog, jobs: list[UUID], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A tenth of the time would be a pause of 20 seconds."""
    look, looks = dependencies._load_watched_states, 0

    def slow_at_first(catalog: Catalog, job_ids: set[UUID]) -> dict[UUID, WatchedState]:
        nonlocal looks
        looks += 1
        states = look(catalog, job_ids)
        time.sleep(2.0 if looks == 1 else 0.0)
        return states

    monkeypatch.setattr(dependencies, "_load_watched_states", slow_at_first)

    async def scenario() -> None:
        wait = asyncio.create_task(JobNotifier(catalog).wait_until_finished(jobs[0], LONG))
        await asyncio.sleep(1.0)
        set_columns(catalog, jobs[0], state=JobState.FAILED)
        await asyncio.wait_for(wait, LONG / 2)

    asyncio.run(scenario())


def test_job_that_is_gone_is_not_waited_for(catalog: Catalog) -> None:
    asyncio.run(JobNotifier(catalog).wait_until_finished(new_id(), LONG))


def test_waiting_ends_when_the_time_is_up(catalog: Catalog, jobs: list[UUID]) -> None:
    asyncio.run(JobNotifier(catalog).wait_until_finished(jobs[0], 0.05))


def test_stopping_server_lets_nobody_wait_for_long(
    catalog: Catalog, jobs: list[UUID], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dependencies, "SHUTDOWN_WAIT_SECONDS", 0.0)

    async def scenario() -> None:
        watch = JobNotifier(catalog)
        wait = asyncio.create_task(watch.wait_until_finished(jobs[0], 10 * LONG))
        await started(wait)
        watch.begin_shutdown()
        await asyncio.wait_for(wait, LONG)

    asyncio.run(scenario())


def count_looks(monkeypatch: pytest.MonkeyPatch, looks: list[set[UUID]]) -> None:
    real = dependencies._load_watched_states

    def counted(catalog: Catalog, job_ids: set[UUID]) -> dict[UUID, WatchedState]:
        looks.append(job_ids)
        return real(catalog, job_ids)

    monkeypatch.setattr(dependencies, "_load_watched_states", counted)


def test_all_that_wait_share_one_look(
    catalog: Catalog, jobs: list[UUID], monkeypatch: pytest.MonkeyPatch
) -> None:
    looks: list[set[UUID]] = []
    count_looks(monkeypatch, looks)

    async def scenario() -> None:
        watch = JobNotifier(catalog)
        waits = [
            asyncio.create_task(watch.wait_until_finished(jobs[n % 3], LONG)) for n in range(60)
        ]
        await started(*waits)
        before = len(looks)
        assert before <= 6, "one look serves all sixty"
        assert looks[-1] == set(jobs)
        for job in jobs:
            set_columns(catalog, job, state=JobState.SUCCEEDED)
        await asyncio.wait_for(asyncio.gather(*waits), LONG)
        after = len(looks)
        await asyncio.sleep(5 * dependencies.NOTIFIER_POLL_SECONDS)
        assert len(looks) == after, "nobody waits, nobody looks"

    asyncio.run(scenario())


def test_all_event_streams_share_one_look_and_wake_at_their_jobs_change(
    catalog: Catalog, jobs: list[UUID], monkeypatch: pytest.MonkeyPatch
) -> None:
    looks: list[set[UUID]] = []
    read: list[set[UUID]] = []
    count_looks(monkeypatch, looks)
    real = dependencies._load_jobs

    def counted(catalog: Catalog, job_ids: set[UUID]) -> dict[UUID, Job]:
        read.append(job_ids)
        return real(catalog, job_ids)

    monkeypatch.setattr(dependencies, "_load_jobs", counted)
    monkeypatch.setattr(dependencies, "CHANGE_POLL_SECONDS", 0.1)

    async def scenario() -> None:
        watch = JobNotifier(catalog)
        seen = await asyncio.gather(*(watch.wait_for_change(job, (), LONG) for job in jobs))
        marks = {change.job.id: change.state for change in seen if change}
        looks.clear()
        read.clear()
        waits = [
            asyncio.create_task(watch.wait_for_change(jobs[n % 3], marks[jobs[n % 3]], LONG))
            for n in range(500)
        ]
        await asyncio.sleep(0.5)
        assert 1 <= len(looks) <= 6, "not one for each stream"
        assert read == [], "nothing has changed: nothing is read"
        assert not any(wait.done() for wait in waits)
        set_columns(catalog, jobs[1], progress_done=7)
        for change in await asyncio.wait_for(asyncio.gather(*waits[1::3]), LONG):
            assert change is not None
            assert change.job.progress_done == 7
        assert read == [{jobs[1]}]
        assert not any(wait.done() for wait in waits[0::3])
        watch.begin_shutdown()
        ended = await asyncio.wait_for(asyncio.gather(*waits[0::3]), LONG)
        assert set(ended) == {None}, "a server that stops ends its streams"
        assert await watch.wait_for_change(jobs[0], (), LONG) is None

    asyncio.run(scenario())


def test_waiting_for_a_change_ends_with_an_outage_of_the_catalog_and_with_the_timeout(
    catalog: Catalog, jobs: list[UUID], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(catalog: Catalog, job_ids: set[UUID]) -> dict[UUID, WatchedState]:
        raise OperationalError("select", {}, Exception("away"))

    async def wait(seconds: float) -> Change | None:
        return await JobNotifier(catalog).wait_for_change(jobs[0], (), seconds)

    with pytest.raises(TimeoutError):
        asyncio.run(wait(0.001))
    monkeypatch.setattr(dependencies, "_load_watched_states", fail)
    with pytest.raises(OperationalError):
        asyncio.run(wait(LONG))


def test_a_client_that_disconnects_ends_no_other_wait(catalog: Catalog, jobs: list[UUID]) -> None:
    async def scenario() -> None:
        watch = JobNotifier(catalog)
        goes, stays = (
            asyncio.create_task(watch.wait_until_finished(jobs[0], LONG)) for _ in range(2)
        )
        await started(goes, stays)
        goes.cancel()
        set_columns(catalog, jobs[0], state=JobState.SUCCEEDED)
        await asyncio.wait_for(stays, LONG)

    asyncio.run(scenario())
