"""One look at the job table for all requests that wait for a job's end, or for its next change.

Requests that each looked for themselves would have to look rarely; this one may look often, so that
an answer does not lie there for long.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any
from uuid import UUID

from sqlalchemy import select
from starlette.concurrency import run_in_threadpool

from shared.catalog.session import Catalog
from shared.jobs import Job
from shared.jobs.table import UNFINISHED_STATES

NOTIFIER_POLL_SECONDS = 0.02  # while someone waits for an end
CHANGE_LOOK_SECONDS = 0.25  # while someone waits for a change
LOOK_SHARE = 10  # a look that takes long is taken seldom: one part in so many of the time
# Of a server that stops: most queries end within it, and the others still get an answer.
SHUTDOWN_WAIT_SECONDS = 5.0

# What changes when a job does. Less than the whole row: it is read often, and of many jobs.
MARKS = (
    Job.state,
    Job.stage,
    Job.waiting_for,
    Job.awaited,
    Job.progress_done,
    Job.progress_total,
    Job.progress_failed,
    Job.attempts,
)
Mark = tuple[Any, ...]
"""The values of MARKS; () for a job that nobody has looked at."""


@dataclass(frozen=True, slots=True)
class Change:
    """A job after a change, and the mark to wait with for the next one."""

    job: Job
    mark: Mark


@dataclass(eq=False, slots=True)
class _Waiter:
    job_id: UUID
    mark: Mark | None
    """What its request has seen of the job; None where only the end counts."""
    future: asyncio.Future[Change | None]


class JobNotifier:
    """Used from one event loop; looks only while someone waits."""

    def __init__(self, catalog: Catalog) -> None:
        self._catalog = catalog
        self._waiters: set[_Waiter] = set()
        self._looks: asyncio.Task[None] | None = None
        self._next_change_look = 0.0
        self._shutdown_deadline = math.inf

    def begin_shutdown(self) -> None:
        """The server stops: nobody waits for a change any more, and for an end not longer than
        LAST_SECONDS from now."""
        self._shutdown_deadline = time.monotonic() + SHUTDOWN_WAIT_SECONDS
        _release(waiter for waiter in self._waiters if waiter.mark is not None)

    async def wait_until_finished(self, job_id: UUID, seconds: float) -> None:
        """Returns when the job has ended or is gone, at the latest after so many seconds.

        Raises what the catalog raises while it is away.
        """
        left = min(seconds, self._shutdown_deadline - time.monotonic())
        try:
            await self._wait(job_id, None, left)
        except TimeoutError:
            return

    async def wait_for_change(self, job_id: UUID, mark: Mark, seconds: float) -> Change | None:
        """The job once it differs from `mark`; None when it is gone or the server stops.

        Raises TimeoutError after so many seconds, and what the catalog raises while it is away.
        """
        if self._shutdown_deadline < math.inf:
            return None
        return await self._wait(job_id, mark, seconds)

    async def _wait(self, job_id: UUID, mark: Mark | None, seconds: float) -> Change | None:
        waiter = _Waiter(job_id, mark, asyncio.get_running_loop().create_future())
        self._waiters.add(waiter)
        if self._looks is None:
            self._looks = asyncio.create_task(self._look_while_awaited())
        try:
            return await asyncio.wait_for(waiter.future, seconds)
        finally:
            self._waiters.discard(waiter)

    async def _look_while_awaited(self) -> None:
        pause = NOTIFIER_POLL_SECONDS
        try:
            while self._waiters:
                await asyncio.sleep(pause)
                began = time.monotonic()
                await self._pending_poll(began)
                took = time.monotonic() - began
                ends = any(waiter.mark is None for waiter in self._waiters)
                least = NOTIFIER_POLL_SECONDS if ends else CHANGE_LOOK_SECONDS
                pause = max(least, LOOK_SHARE * took)
        finally:
            self._looks = None

    async def _pending_poll(self, now: float) -> None:
        """Wake whose job has ended, or has changed."""
        due = set(self._waiters)
        if now >= self._next_change_look:
            self._next_change_look = now + CHANGE_LOOK_SECONDS
        else:
            due = {waiter for waiter in due if waiter.mark is None}
        if not due:
            return
        try:
            marks = await run_in_threadpool(_marks, self._catalog, {w.job_id for w in due})
            ready = {waiter for waiter in due if _is_ready(waiter, marks.get(waiter.job_id))}
            changed = {waiter.job_id for waiter in ready if waiter.mark is not None}
            jobs = await run_in_threadpool(_jobs, self._catalog, changed) if changed else {}
        except Exception as error:  # whoever waits raises it
            for waiter in due:
                if not waiter.future.done():
                    waiter.future.set_exception(error)
            return
        for waiter in ready:
            if not waiter.future.done():
                job = jobs.get(waiter.job_id)
                waiter.future.set_result(None if job is None else Change(job, marks[job.id]))
        if now >= self._shutdown_deadline:
            _release(self._waiters)


def _release(waiters: Iterable[_Waiter]) -> None:
    for waiter in waiters:
        if not waiter.future.done():
            waiter.future.set_result(None)


def _is_ready(waiter: _Waiter, mark: Mark | None) -> bool:
    """Has the job ended or changed? `mark` is None for one that is gone."""
    if mark is None:
        return True
    return mark[0] not in UNFINISHED_STATES if waiter.mark is None else mark != waiter.mark


def _marks(catalog: Catalog, job_ids: set[UUID]) -> dict[UUID, Mark]:
    """Of the jobs that are there."""
    with catalog.read() as session:
        rows = session.execute(select(Job.id, *MARKS).where(Job.id.in_(job_ids)))
        return {row[0]: tuple(row[1:]) for row in rows}


def _jobs(catalog: Catalog, job_ids: set[UUID]) -> dict[UUID, Job]:
    with catalog.read() as session:
        jobs = session.scalars(select(Job).where(Job.id.in_(job_ids)))
        return {job.id: job for job in jobs}
