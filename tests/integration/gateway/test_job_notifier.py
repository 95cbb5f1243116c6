"""Waiting for jobs: many requests share one poll of the table, and none is answered too early."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from uuid import UUID

import pytest
from sqlalchemy import event
from sqlalchemy.exc import OperationalError

from services.gateway.dependencies import NOTIFIER_POLL_SECONDS, JobNotifier
from shared.catalog.database.schema import migrate
from shared.catalog.database.session import Catalog
from shared.ids import new_id
from shared.jobs import JobState
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
    """Return when the job table was polled at least once."""
    await asyncio.sleep(5 * NOTIFIER_POLL_SECONDS)
    assert not any(wait.done() for wait in waits)


def test_each_waits_until_its_own_job_has_ended(catalog: Catalog, jobs: list[UUID]) -> None:
    async def scenario() -> None:
        notifier = JobNotifier(catalog)
        waits = [asyncio.create_task(notifier.wait_until_finished(job, LONG)) for job in jobs]
        await started(*waits)
        for job, wait in zip(jobs, waits, strict=True):
            assert not wait.done()
            set_columns(catalog, job, state=JobState.FAILED)
            await asyncio.wait_for(wait, LONG)

    asyncio.run(scenario())


@contextlib.contextmanager
def on_each_select(catalog: Catalog, act: Callable[[str], object]) -> Iterator[None]:
    """Call `act` with each SELECT of the block, before it is executed."""

    def listen(_connection: object, _cursor: object, statement: str, *_: object) -> None:
        if statement.startswith("SELECT"):
            act(statement)

    event.listen(catalog.engine, "before_cursor_execute", listen)
    try:
        yield
    finally:
        event.remove(catalog.engine, "before_cursor_execute", listen)


def test_one_slow_poll_does_not_delay_the_next_ones(catalog: Catalog, jobs: list[UUID]) -> None:
    """A tenth of the time would be a pause of 20 seconds."""
    pauses = iter([2.0])

    async def scenario() -> None:
        wait = asyncio.create_task(JobNotifier(catalog).wait_until_finished(jobs[0], LONG))
        await asyncio.sleep(1.0)
        set_columns(catalog, jobs[0], state=JobState.FAILED)
        await asyncio.wait_for(wait, LONG / 2)

    with on_each_select(catalog, lambda _: time.sleep(next(pauses, 0.0))):
        asyncio.run(scenario())


def test_waiting_ends_when_the_job_is_gone_or_the_time_is_up(
    catalog: Catalog, jobs: list[UUID]
) -> None:
    asyncio.run(JobNotifier(catalog).wait_until_finished(new_id(), LONG))
    asyncio.run(JobNotifier(catalog).wait_until_finished(jobs[0], 0.05))


def test_a_stopping_server_releases_the_waiting_requests(
    catalog: Catalog, jobs: list[UUID]
) -> None:
    async def scenario() -> None:
        notifier = JobNotifier(catalog, shutdown_wait_seconds=0.0)
        wait = asyncio.create_task(notifier.wait_until_finished(jobs[0], 10 * LONG))
        await started(wait)
        notifier.begin_shutdown()
        await asyncio.wait_for(wait, LONG)

    asyncio.run(scenario())


def test_waiting_requests_share_one_poll(catalog: Catalog, jobs: list[UUID]) -> None:
    polls: list[str] = []

    async def scenario() -> None:
        notifier = JobNotifier(catalog)
        waits = [
            asyncio.create_task(notifier.wait_until_finished(jobs[n % 3], LONG)) for n in range(60)
        ]
        await started(*waits)
        assert len(polls) <= 6, "one poll serves all sixty"
        for job in jobs:
            set_columns(catalog, job, state=JobState.SUCCEEDED)
        await asyncio.wait_for(asyncio.gather(*waits), LONG)
        polls.clear()
        await asyncio.sleep(5 * NOTIFIER_POLL_SECONDS)
        assert polls == [], "nothing is polled while no request waits"

    with on_each_select(catalog, polls.append):
        asyncio.run(scenario())


def test_long_waits_are_polled_less_often(catalog: Catalog, jobs: list[UUID]) -> None:
    """The first pace would be 100 polls in this time; a new request is answered as fast as ever."""
    polls: list[str] = []

    async def scenario() -> None:
        notifier = JobNotifier(catalog)
        wait = asyncio.create_task(notifier.wait_until_finished(jobs[0], LONG))
        await asyncio.sleep(2.0)
        assert len(polls) <= 70
        polls.clear()
        await notifier.wait_until_finished(new_id(), LONG)
        wait.cancel()

    with on_each_select(catalog, polls.append):
        asyncio.run(scenario())
    assert len(polls) == 1


def test_waiting_ends_with_an_outage_of_the_catalog(catalog: Catalog, jobs: list[UUID]) -> None:
    def fail(statement: str) -> None:
        raise OperationalError(statement, {}, Exception("unreachable"))

    with on_each_select(catalog, fail), pytest.raises(OperationalError):
        asyncio.run(JobNotifier(catalog).wait_until_finished(jobs[0], LONG))


def test_a_client_that_disconnects_ends_no_other_wait(catalog: Catalog, jobs: list[UUID]) -> None:
    async def scenario() -> None:
        notifier = JobNotifier(catalog)
        goes, stays = (
            asyncio.create_task(notifier.wait_until_finished(jobs[0], LONG)) for _ in range(2)
        )
        await started(goes, stays)
        goes.cancel()
        set_columns(catalog, jobs[0], state=JobState.SUCCEEDED)
        await asyncio.wait_for(stays, LONG)

    asyncio.run(scenario())
