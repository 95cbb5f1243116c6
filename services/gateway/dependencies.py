"""What every route can reach, and the parameters that every call understands.

One look at the job table for all requests that wait for a job's end, or for its next change.

Requests that each looked for themselves would have to look rarely; this one may look often, so that
an answer does not lie there for long.

Waiting for a job inside a request: `Prefer: wait=N`, `?wait=N` and the event stream.

A misspelt parameter is refused: as a filter it would silently let everything pass.
"""

from __future__ import annotations

import asyncio
import math
import re
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Annotated, Any
from uuid import UUID

from fastapi import Depends, Query, Request
from fastapi.openapi.utils import get_openapi
from fastapi.routing import APIRoute
from prometheus_client import CollectorRegistry
from pydantic import BeforeValidator
from sqlalchemy import select
from starlette.concurrency import run_in_threadpool

from services.gateway.authentication import Authenticator
from services.http_connections import ConnectionLimits, Connections
from shared.catalog.jobs import UNFINISHED_STATES
from shared.catalog.maps import DEFAULT_MAP
from shared.catalog.session import Catalog
from shared.config.settings import Settings
from shared.errors import NotFound, invalid_field_error
from shared.jobs import Job, Wakeups
from shared.search_api.protocol import SearchBackend
from shared.storage import ObjectStore

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


API_PREFIX = "/api/v1"
NO_NUL_PATTERN = r"^[^\x00]*$"  # PostgreSQL has no text with a NUL


@dataclass(frozen=True, slots=True)
class GatewayContext:
    """The ports that the gateway speaks to."""

    catalog: Catalog
    store: ObjectStore
    hints: Wakeups
    search: SearchBackend
    settings: Settings
    authenticator: Authenticator
    registry: CollectorRegistry = field(default_factory=CollectorRegistry)
    """Of the process's figures: in the embedded Placewise, of all of its parts."""
    started_monotonic: float = field(default_factory=time.monotonic)
    job_notifier: JobNotifier = field(init=False)
    connections: Connections = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "job_notifier", JobNotifier(self.catalog))
        object.__setattr__(self, "connections", Connections(ConnectionLimits.of(self.settings)))


def get_gateway_context(request: Request) -> GatewayContext:
    gateway: GatewayContext = request.app.state.gateway
    return gateway


def _uuid_or_not_found(noun: str):  # type: ignore[no-untyped-def]
    def parse(value: object) -> UUID:
        try:
            return UUID(str(value))
        except ValueError:
            # What is no id can't be the id of anything: 404, like any other unknown one.
            raise NotFound(f"{noun}_not_found", f"There is no {noun} {value!r}.") from None

    return BeforeValidator(parse)


def parse_cursor(cursor: str | None) -> UUID | None:
    """The id that a page ended with; 422 for a cursor that no call has given."""
    try:
        return UUID(cursor) if cursor else None
    except ValueError:
        raise invalid_field_error("cursor", "is not one that this call has given") from None


GatewayDep = Annotated[GatewayContext, Depends(get_gateway_context)]
MapName = Annotated[
    str,
    Query(
        alias="map",
        description="The map that is meant.",
        min_length=1,
        max_length=100,
        pattern=NO_NUL_PATTERN,
    ),
]
FileId = Annotated[UUID, _uuid_or_not_found("photo")]
UploadId = Annotated[UUID, _uuid_or_not_found("upload")]
JobId = Annotated[UUID, _uuid_or_not_found("job")]
GenerationId = Annotated[UUID, _uuid_or_not_found("generation")]
KeyId = Annotated[UUID, _uuid_or_not_found("key")]
WebhookId = Annotated[UUID, _uuid_or_not_found("webhook")]


def parse_prefer_wait(request: Request, max_seconds: int) -> float:
    """Seconds from `Prefer: wait=N` (RFC 7240), at most `max_seconds`; 0 when not asked."""
    found = re.search(r"(?:^|[,;\s])wait\s*=\s*\"?(\d+)", request.headers.get("prefer", ""))
    return min(float(found[1]), max_seconds) if found else 0.0


def load_job(gateway: GatewayContext, job_id: UUID) -> Job | None:
    with gateway.catalog.read() as session:
        return session.get(Job, job_id)


async def wait_for_job(gateway: GatewayContext, job_id: UUID, seconds: float) -> Job | None:
    """The job once it has ended, or as it is when the time is up; None when it is gone."""
    await gateway.job_notifier.wait_until_finished(job_id, seconds)
    return await run_in_threadpool(load_job, gateway, job_id)


# Clients send it with every call, also with the few that mean no map.
ALWAYS_ALLOWED = frozenset({"map"})

# By function and method: to describe a call takes some ten milliseconds.
_documented_by_route: dict[tuple[Callable[..., Any], str], frozenset[str] | None] = {}


async def reject_unknown_query_parameters(request: Request) -> None:
    """422 (`invalid_field_error`) names a query parameter that the call's description does not."""
    if not request.query_params:
        return
    route: APIRoute = request.scope["route"]
    call = route.endpoint, request.method.lower()
    if call not in _documented_by_route:
        _documented_by_route[call] = _documented_parameters(route, request.method.lower())
    known = _documented_by_route[call]
    if known is None:  # such as HEAD, which the description leaves out
        return
    for name in request.query_params:
        if name not in known:
            raise invalid_field_error(name, f"is unknown; known are {', '.join(sorted(known))}")


def _documented_parameters(route: APIRoute, method: str) -> frozenset[str] | None:
    """What the route takes after the question mark; None for a method without a description."""
    described = get_openapi(title="", version="", routes=[route])["paths"]
    call = described.get(route.path_format, {}).get(method)
    if call is None:
        return None
    return ALWAYS_ALLOWED | {
        parameter["name"] for parameter in call.get("parameters", ()) if parameter["in"] == "query"
    }


__all__ = [
    "API_PREFIX",
    "DEFAULT_MAP",
    "NO_NUL_PATTERN",
    "FileId",
    "GatewayContext",
    "GatewayDep",
    "GenerationId",
    "JobId",
    "KeyId",
    "MapName",
    "UploadId",
    "WebhookId",
    "parse_cursor",
]
