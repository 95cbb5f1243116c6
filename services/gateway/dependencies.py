"""Dependencies of the routes: `GatewayContext`, path and query parameters, and the job notifier.

`JobNotifier` implements long polling (`Prefer: wait=N`, `?wait=N`). It polls the job table once for
all waiting requests, so it can poll often without loading the database.
"""

from __future__ import annotations

import asyncio
import collections
import math
import re
import threading
import time
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, TypeVar
from uuid import UUID

from cachetools import LRUCache
from fastapi import Depends, Query, Request
from prometheus_client import CollectorRegistry, Counter
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field
from sqlalchemy import select
from sqlalchemy.orm import Session
from starlette.concurrency import run_in_threadpool

from services.gateway.authentication import Authenticator, get_caller
from services.http_connections import ConnectionLimits, Connections
from shared.catalog.database.base import Condition, list_newest
from shared.catalog.database.session import Catalog
from shared.catalog.jobs import UNFINISHED_STATES, get_job
from shared.catalog.maps import DEFAULT_MAP, get_map
from shared.config.settings import Settings
from shared.errors import NotFound, PlacewiseError, invalid_field_error
from shared.evaluation.places.evidence import RankedPhoto
from shared.jobs import Job, Wakeups
from shared.search_api.protocol import SearchBackend
from shared.storage import OwnedStore

MAX_WAIT_SECONDS = 60.0  # of `Prefer: wait` and `?wait=`
NOTIFIER_POLL_SECONDS = 0.02
POLL_COST_DIVISOR = 2  # at most a third of the time is spent polling: slow polls become rare
MAX_POLL_PAUSE_SECONDS = 1.0  # the jobs of waiting requests may have ended
WAITED_SHARE = 0.05  # of the time since the latest request began to wait, as a pause: jobs are long
# Requests may wait this long after the shutdown has begun. Most queries end within this time.
SHUTDOWN_WAIT_SECONDS = 5.0
CACHED_RANKINGS = 1000  # of about 50 photos: 20 MB


@dataclass(eq=False, slots=True)
class _Waiter:
    job_id: UUID
    future: asyncio.Future[None]


class JobNotifier:
    """Notifies requests of the end of jobs.

    Must be used from one event loop. Polls only while requests are waiting.
    """

    def __init__(
        self, catalog: Catalog, shutdown_wait_seconds: float = SHUTDOWN_WAIT_SECONDS
    ) -> None:
        self._catalog = catalog
        self._shutdown_wait_seconds = shutdown_wait_seconds
        self._waiters: set[_Waiter] = set()
        self._poll_task: asyncio.Task[None] | None = None
        self._latest_wait = 0.0  # when it began
        self._shutdown_deadline = math.inf

    def begin_shutdown(self) -> None:
        """Release the waiting requests after `shutdown_wait_seconds` at the latest."""
        self._shutdown_deadline = time.monotonic() + self._shutdown_wait_seconds

    async def wait_until_finished(self, job_id: UUID, seconds: float) -> None:
        """Wait until the job has ended or been deleted, at most `seconds`.

        Raises:
            SQLAlchemyError: The catalog can't be reached.
        """
        timeout = min(seconds, self._shutdown_deadline - time.monotonic())
        waiter = _Waiter(job_id, asyncio.get_running_loop().create_future())
        self._waiters.add(waiter)
        self._latest_wait = time.monotonic()
        if self._poll_task is None:
            self._poll_task = asyncio.create_task(self._poll_while_awaited())
        try:
            await asyncio.wait_for(waiter.future, timeout)
        except TimeoutError:
            return
        finally:
            self._waiters.discard(waiter)

    async def _poll_while_awaited(self) -> None:
        polled = cost = 0.0
        try:
            while self._waiters:
                await asyncio.sleep(NOTIFIER_POLL_SECONDS)
                started = time.monotonic()
                waited = started - self._latest_wait
                pause = max(POLL_COST_DIVISOR * cost, WAITED_SHARE * waited)
                if started - polled < min(pause, MAX_POLL_PAUSE_SECONDS):
                    continue
                await self._poll(started)
                polled = time.monotonic()
                cost = polled - started
        finally:
            self._poll_task = None

    async def _poll(self, now: float) -> None:
        """Wake the waiters whose jobs have ended or are gone; all of them after the shutdown."""
        waiters = set(self._waiters)
        if not waiters:
            return
        try:
            job_ids = {waiter.job_id for waiter in waiters}
            unfinished = await run_in_threadpool(_find_unfinished, self._catalog, job_ids)
        except Exception as error:  # raised by the waiting requests
            for waiter in waiters:
                if not waiter.future.done():
                    waiter.future.set_exception(error)
            return
        for waiter in waiters:
            is_over = waiter.job_id not in unfinished or now >= self._shutdown_deadline
            if is_over and not waiter.future.done():
                waiter.future.set_result(None)


def _find_unfinished(catalog: Catalog, job_ids: set[UUID]) -> set[UUID]:
    unfinished = select(Job.id).where(Job.id.in_(job_ids), Job.state.in_(UNFINISHED_STATES))
    with catalog.read() as session:
        return set(session.scalars(unfinished))


API_PREFIX = "/api/v1"
LIST_PARAMETERS = {"state", "kind"}
NO_NUL_PATTERN = r"^[^\x00]*$"  # PostgreSQL's text type can't store NUL


Row = TypeVar("Row")


@dataclass(eq=False, slots=True)
class GatewayContext:
    """The stores, clients and settings that the routes use."""

    catalog: Catalog
    store: OwnedStore
    wakeups: Wakeups
    search: SearchBackend
    settings: Settings
    authenticator: Authenticator
    registry: CollectorRegistry = field(default_factory=CollectorRegistry)
    """Metrics of the process; in the embedded server, of all its services."""
    started_monotonic: float = field(default_factory=time.monotonic)
    job_notifier: JobNotifier = field(init=False)
    connections: Connections = field(init=False)
    neighbours: LRUCache[Hashable, Sequence[RankedPhoto]] = field(
        default_factory=lambda: LRUCache(CACHED_RANKINGS)
    )
    """Rankings by stored photos, with the key of all that they depend on."""
    neighbours_lock: threading.Lock = field(default_factory=threading.Lock)
    lan_url: str | None = None
    """URL of this server for other devices of its network, if it is known."""
    track_frames: Counter = field(init=False)
    """Applied frames of tracks by the status of the track, or `failed`."""

    def __post_init__(self) -> None:
        self.job_notifier = JobNotifier(self.catalog)
        self.connections = Connections(ConnectionLimits.of(self.settings))
        self.track_frames = Counter(
            "placewise_gateway_track_frames",
            "Frames of tracks that were applied, by the status of their track.",
            ["status"],
            registry=self.registry,
        )


async def _get_gateway_context(request: Request) -> GatewayContext:
    gateway: GatewayContext = request.app.state.gateway
    return gateway


def _uuid_or_not_found(noun: str):  # type: ignore[no-untyped-def]
    def parse(value: object) -> UUID:
        try:
            return UUID(str(value))
        except ValueError:
            # A malformed id can't exist either: 404, as for any other unknown id.
            raise NotFound(f"{noun}_not_found", f"There is no {noun} {value!r}.") from None

    return BeforeValidator(parse)


class MapParams(BaseModel):
    """Query parameters of an endpoint; subclasses add theirs.

    Unknown parameters are refused: a misspelt filter would match every photo. Clients send `map`
    with every request, so it is accepted everywhere.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    map: str = Field(
        DEFAULT_MAP,
        description="The map to use.",
        min_length=1,
        max_length=100,
        pattern=NO_NUL_PATTERN,
    )


class PageParams(BaseModel):
    """Query parameters of a list that is returned in pages, newest first."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    limit: int = Field(50, ge=1, le=1000)
    cursor: str | None = Field(None, description="`next_cursor` of the previous page")

    @property
    def before(self) -> UUID | None:
        """The id of the last row of the previous page; 422 (`invalid_field`) if it is malformed."""
        try:
            return UUID(self.cursor) if self.cursor else None
        except ValueError:
            raise invalid_cursor_error() from None

    def read(
        self, session: Session, table: type[Row], *conditions: Condition
    ) -> tuple[list[Row], str | None]:
        """Read a page of the newest rows that match, and the cursor of the next one, if any."""
        rows = list_newest(session, table, *conditions, limit=self.limit + 1, before=self.before)
        return self.split(rows)

    def split(
        self, rows: list[Row], cursor_of: Callable[[Any], object] = lambda row: row.id
    ) -> tuple[list[Row], str | None]:
        """Split up to `limit + 1` rows into the page and the cursor of the next one, if any."""
        page = rows[: self.limit]
        return page, str(cursor_of(page[-1])) if len(rows) > self.limit else None


class MapPageParams(MapParams, PageParams):
    """Query parameters of a list of a map that is returned in pages, newest first."""


def invalid_cursor_error() -> PlacewiseError:
    """Build the 422 error for a malformed cursor."""
    return invalid_field_error("cursor", "is not a cursor that this endpoint returned")


def get_map_name(request: Request) -> str:
    """Return the name of the request's map, for dependencies; routes declare `MapParams`."""
    return request.query_params.get("map", DEFAULT_MAP)


async def _reject_repeated_parameters(request: Request) -> None:
    """Raise Unprocessable: of several values, FastAPI would silently take the last one."""
    names = (name for name, _ in request.query_params.multi_items())
    counts = collections.Counter(name for name in names if name not in LIST_PARAMETERS)
    for name, count in counts.most_common(1):
        if count > 1:
            raise invalid_field_error(name, "is given twice; commas separate several values")


async def _accept_no_parameters(
    _params: Annotated[MapParams, Query(include_in_schema=False)],
) -> None:
    pass


async def _require_all_maps(request: Request) -> None:
    get_caller(request).check_all_maps()


MapQuery = Annotated[MapParams, Query()]
PageQuery = Annotated[MapPageParams, Query()]
NO_PARAMETERS = Depends(_accept_no_parameters)
"""Dependency of endpoints that use no query parameters."""
NO_REPEATS = Depends(_reject_repeated_parameters)
ALL_MAPS = Depends(_require_all_maps)
"""Dependency of endpoints about no map or all maps: keys for some maps are refused."""
GatewayDep = Annotated[GatewayContext, Depends(_get_gateway_context)]
FileId = Annotated[UUID, _uuid_or_not_found("photo")]
JobId = Annotated[UUID, _uuid_or_not_found("job")]
GenerationId = Annotated[UUID, _uuid_or_not_found("generation")]
KeyId = Annotated[UUID, _uuid_or_not_found("key")]
TrackId = Annotated[UUID, _uuid_or_not_found("track")]
FrameId = Annotated[UUID, _uuid_or_not_found("frame")]
ReconstructionId = Annotated[UUID, _uuid_or_not_found("reconstruction")]
WebhookId = Annotated[UUID, _uuid_or_not_found("webhook")]


def parse_prefer_wait(request: Request) -> float:
    """Seconds from `Prefer: wait=N` (RFC 7240), at most MAX_WAIT_SECONDS; 0 without the header."""
    match = re.search(r"(?:^|[,;\s])wait\s*=\s*\"?(\d+)", request.headers.get("prefer", ""))
    return min(float(match[1]), MAX_WAIT_SECONDS) if match else 0.0


def load_job_of_map(gateway: GatewayContext, map_name: str, job_id: UUID) -> Job:
    """Load a job of a map; raises as `get_map` and `get_job` do."""
    with gateway.catalog.read() as session:
        return get_job(session, get_map(session, map_name).id, job_id)


async def wait_for_job(gateway: GatewayContext, job_id: UUID, seconds: float) -> Job | None:
    """Wait at most `seconds` for the end of the job; return None if the job was deleted."""
    await gateway.job_notifier.wait_until_finished(job_id, seconds)

    def load() -> Job | None:
        with gateway.catalog.read() as session:
            return session.get(Job, job_id)

    return await run_in_threadpool(load)
