"""Refusing work before anything fills up: the queue, the disk, this process's memory.

A route that makes jobs names what it needs room for, which is asked before its body is read:

    @router.post("/evaluations", dependencies=[ROOM_FOR_JOBS])

and one that receives a file does it `with room.receiving(Kind.UPLOAD, request):`. Query photos have
limits of their own: however many uploads wait, a query is asked.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections import Counter
from contextlib import AbstractContextManager
from enum import StrEnum
from typing import Annotated
from uuid import UUID

from fastapi import Depends, Request

from services.gateway.concurrency import ConcurrencyLimit
from services.gateway.context import DEFAULT_MAP, GatewayDep, MapName
from services.gateway.key_check import caller_of
from services.gateway.keys import Caller
from shared.catalog.session import Catalog
from shared.disk_space import QUERY_SHARE, DiskSpace
from shared.errors import TooManyRequests
from shared.intake.photo_quota import PhotoQuota
from shared.jobs.waiting import Waiting, look_at_queue
from shared.settings import Settings

LOOK_SECONDS = 1.0
LOOK_SHARE = 20  # a look that takes long is taken seldom: one part in so many of the time
RELIEF = 0.9  # of a limit: come again when the queue has shrunk to this
MOST_RETRY_SECONDS = 60
RECEIVING_RETRY_SECONDS = 1
STREAM_RETRY_SECONDS = 10  # others watch jobs, which may take long: polling is better


class Kind(StrEnum):
    UPLOAD = "uploads"
    QUERY = "query photos"


class Room:
    """What one gateway still takes. Thread-safe."""

    def __init__(self, catalog: Catalog, settings: Settings) -> None:
        self._catalog = catalog
        self._settings = settings
        self.disk = DiskSpace(settings)
        self._looking = threading.Lock()
        self._seen: Waiting | None = None
        self._next_look = 0.0
        self._taken: Counter[str | None] = Counter()  # since the last look; None: queries
        self._receiving = {
            kind: ConcurrencyLimit(
                f"{kind} (MAX_CONCURRENT_UPLOADS, MAX_CONCURRENT_UPLOADS_PER_CALLER)",
                "too_many_uploads",
                total=settings.max_concurrent_uploads,
                per_caller=settings.max_concurrent_uploads_per_caller,
                retry_after_seconds=RECEIVING_RETRY_SECONDS,
            )
            for kind in Kind
        }
        self.event_streams = ConcurrencyLimit(
            "event streams (MAX_EVENT_STREAMS, MAX_EVENT_STREAMS_PER_CALLER)",
            "too_many_event_streams",
            total=settings.max_event_streams,
            per_caller=settings.max_event_streams_per_caller,
            retry_after_seconds=STREAM_RETRY_SECONDS,
        )

    def take_job(self, map_name: str) -> None:
        """Room for one more job of the map, and for what it stores.

        Raises TooManyRequests (`queue_full`) and StorageFull (`disk_full`).
        """
        self.disk.check()
        seen, settings = self.look(), self._settings
        taken = sum(count for name, count in self._taken.items() if name is not None)
        for what, waiting, most in (
            ("", seen.jobs + taken, settings.max_queued_jobs),
            (
                f" of the map {map_name!r}",
                seen.of_maps.get(map_name, 0) + self._taken[map_name],
                settings.max_queued_jobs_per_map,
            ),
        ):
            if waiting >= most:
                raise _queue_full(f"jobs{what}", waiting, most, seen.finished_per_second)
        self._taken[map_name] += 1

    def take_query(self) -> None:
        """Room for one more query photo; raises as `take_job` does. While uploads are refused for
        want of disk space, queries go on down to QUERY_SHARE of MIN_FREE_BYTES."""
        self.disk.check(QUERY_SHARE)
        seen, most = self.look(), self._settings.max_queued_queries
        waiting = seen.queries + self._taken[None]
        if waiting >= most:
            raise _queue_full("query photos", waiting, most, seen.finished_per_second)
        self._taken[None] += 1

    def receiving(self, kind: Kind, request: Request) -> AbstractContextManager[None]:
        """While a file is received. TooManyRequests (`too_many_uploads`) when enough are already,
        in all, of the call's key or of its address: each holds a part of its file in memory. On the
        event loop only."""
        return self._receiving[kind].hold(request)

    def being_received(self, kind: Kind) -> int:
        return self._receiving[kind].count

    def look(self) -> Waiting:
        """The queue as it was a moment ago."""
        # Whoever finds another one looking goes on with what was seen before.
        due = self._seen is None or time.monotonic() >= self._next_look
        if due and self._looking.acquire(blocking=self._seen is None):
            try:
                self._look_anew()
            finally:
                self._looking.release()
        assert self._seen is not None
        return self._seen

    def _look_anew(self) -> None:
        began = time.monotonic()
        if self._seen is not None and began < self._next_look:
            return  # someone looked while we waited
        most = max(self._settings.max_queued_jobs, self._settings.max_queued_queries)
        self._taken.clear()  # before the look: what comes meanwhile is rather counted twice
        with self._catalog.read() as session:
            self._seen = look_at_queue(session, most)
        took = time.monotonic() - began
        self._next_look = began + max(LOOK_SECONDS, LOOK_SHARE * took)


def get_room(request: Request) -> Room:
    room: Room = request.app.state.room
    return room


RoomDep = Annotated[Room, Depends(get_room)]


def _room_for_jobs(room: RoomDep, map_name: MapName = DEFAULT_MAP) -> None:
    room.take_job(map_name)


def _room_for_queries(room: RoomDep) -> None:
    room.take_query()


def _room_for_photos(request: Request, gateway: GatewayDep) -> None:
    limited = max_photos(caller_of(request), gateway.settings)
    if limited is not None:
        request.app.state.photo_quota.check(*limited)


def place_for_photo(request: Request, settings: Settings) -> AbstractContextManager[None]:
    """In which the caller's photo is stored. TooManyRequests (`photo_quota_reached`)."""
    quota: PhotoQuota = request.app.state.photo_quota
    limited = max_photos(caller_of(request), settings)
    return contextlib.nullcontext() if limited is None else quota.place(*limited)


def max_photos(caller: Caller, settings: Settings) -> tuple[UUID, int] | None:
    """The caller's key, and how many photos may be stored through it; None for any number."""
    most = caller.limits.max_photos or settings.key_max_photos
    return None if caller.key_id is None or most is None else (caller.key_id, most)


ROOM_FOR_PHOTOS = Depends(_room_for_photos)
ROOM_FOR_JOBS = Depends(_room_for_jobs)
ROOM_FOR_QUERIES = Depends(_room_for_queries)


def _queue_full(what: str, waiting: int, most: int, per_second: float) -> TooManyRequests:
    excess = waiting - RELIEF * most
    seconds = excess / per_second if per_second > 0 else MOST_RETRY_SECONDS
    return TooManyRequests(
        "queue_full",
        f"{waiting} {what} wait already, and {most} may. Come again after the time in Retry-After; "
        "more extractors make it shorter.",
        retry_after_seconds=math.ceil(min(max(seconds, 1), MOST_RETRY_SECONDS)),
        waiting=waiting,
        limit=most,
    )
