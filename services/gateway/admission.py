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

from services.gateway.authentication import Caller, get_caller
from services.gateway.concurrency import ConcurrencyLimit
from services.gateway.dependencies import DEFAULT_MAP, GatewayDep, MapName
from shared.catalog.session import Catalog
from shared.config.disk_space import QUERY_SHARE, DiskSpace
from shared.config.settings import Settings
from shared.errors import TooManyRequests
from shared.ingest.store_photo import PhotoQuota
from shared.jobs.queue_depth import QueueDepth, measure_queue_depth

ADMISSION_POLL_SECONDS = 1.0
POLL_COST_DIVISOR = 20  # a look that takes long is taken seldom: one part in so many of the time
RETRY_TARGET_SHARE = 0.9  # of a limit: come again when the queue has shrunk to this
MAX_RETRY_SECONDS = 60
UPLOAD_RETRY_SECONDS = 1
STREAM_RETRY_SECONDS = 10  # others watch jobs, which may take long: polling is better


class UploadKind(StrEnum):
    UPLOAD = "uploads"
    QUERY = "query photos"


class AdmissionControl:
    """What one gateway still takes. Thread-safe."""

    def __init__(self, catalog: Catalog, settings: Settings) -> None:
        self._catalog = catalog
        self._settings = settings
        self.disk = DiskSpace(settings)
        self._refresh_lock = threading.Lock()
        self._queue_depth: QueueDepth | None = None
        self._next_refresh = 0.0
        self._admitted: Counter[str | None] = Counter()  # since the last look; None: queries
        self._active_uploads = {
            kind: ConcurrencyLimit(
                f"{kind} (MAX_CONCURRENT_UPLOADS, MAX_CONCURRENT_UPLOADS_PER_CALLER)",
                "too_many_uploads",
                total=settings.max_concurrent_uploads,
                per_caller=settings.max_concurrent_uploads_per_caller,
                retry_after_seconds=UPLOAD_RETRY_SECONDS,
            )
            for kind in UploadKind
        }
        self.event_streams = ConcurrencyLimit(
            "event streams (MAX_EVENT_STREAMS, MAX_EVENT_STREAMS_PER_CALLER)",
            "too_many_event_streams",
            total=settings.max_event_streams,
            per_caller=settings.max_event_streams_per_caller,
            retry_after_seconds=STREAM_RETRY_SECONDS,
        )

    def admit_job(self, map_name: str) -> None:
        """Room for one more job of the map, and for what it stores.

        Raises TooManyRequests (`queue_full`) and StorageFull (`disk_full`).
        """
        self.disk.check()
        seen, settings = self.queue_depth(), self._settings
        taken = sum(count for name, count in self._admitted.items() if name is not None)
        for what, waiting, most in (
            ("", seen.jobs + taken, settings.max_queued_jobs),
            (
                f" of the map {map_name!r}",
                seen.jobs_by_map.get(map_name, 0) + self._admitted[map_name],
                settings.max_queued_jobs_per_map,
            ),
        ):
            if waiting >= most:
                raise _queue_full_error(f"jobs{what}", waiting, most, seen.finished_per_second)
        self._admitted[map_name] += 1

    def admit_query(self) -> None:
        """Room for one more query photo; raises as `take_job` does. While uploads are refused for
        want of disk space, queries go on down to QUERY_SHARE of MIN_FREE_BYTES."""
        self.disk.check(QUERY_SHARE)
        seen, most = self.queue_depth(), self._settings.max_queued_queries
        waiting = seen.queries + self._admitted[None]
        if waiting >= most:
            raise _queue_full_error("query photos", waiting, most, seen.finished_per_second)
        self._admitted[None] += 1

    def admit_upload(self, kind: UploadKind, request: Request) -> AbstractContextManager[None]:
        """While a file is received. TooManyRequests (`too_many_uploads`) when enough are already,
        in all, of the call's key or of its address: each holds a part of its file in memory. On the
        event loop only."""
        return self._active_uploads[kind].hold(request)

    def active_uploads(self, kind: UploadKind) -> int:
        return self._active_uploads[kind].count

    def queue_depth(self) -> QueueDepth:
        """The queue as it was a moment ago."""
        # Whoever finds another one looking goes on with what was seen before.
        due = self._queue_depth is None or time.monotonic() >= self._next_refresh
        if due and self._refresh_lock.acquire(blocking=self._queue_depth is None):
            try:
                self._refresh()
            finally:
                self._refresh_lock.release()
        assert self._queue_depth is not None
        return self._queue_depth

    def _refresh(self) -> None:
        began = time.monotonic()
        if self._queue_depth is not None and began < self._next_refresh:
            return  # someone looked while we waited
        most = max(self._settings.max_queued_jobs, self._settings.max_queued_queries)
        self._admitted.clear()  # before the look: what comes meanwhile is rather counted twice
        with self._catalog.read() as session:
            self._queue_depth = measure_queue_depth(session, most)
        took = time.monotonic() - began
        self._next_refresh = began + max(ADMISSION_POLL_SECONDS, POLL_COST_DIVISOR * took)


def get_admission_control(request: Request) -> AdmissionControl:
    room: AdmissionControl = request.app.state.admission
    return room


AdmissionDep = Annotated[AdmissionControl, Depends(get_admission_control)]


def _admit_job(admission: AdmissionDep, map_name: MapName = DEFAULT_MAP) -> None:
    admission.admit_job(map_name)


def _admit_query(admission: AdmissionDep) -> None:
    admission.admit_query()


def _check_photo_quota(request: Request, gateway: GatewayDep) -> None:
    limited = photo_limit(get_caller(request), gateway.settings)
    if limited is not None:
        request.app.state.photo_quota.check(*limited)


def place_for_photo(request: Request, settings: Settings) -> AbstractContextManager[None]:
    """In which the caller's photo is stored. TooManyRequests (`photo_quota_reached`)."""
    quota: PhotoQuota = request.app.state.photo_quota
    limited = photo_limit(get_caller(request), settings)
    return contextlib.nullcontext() if limited is None else quota.reserve(*limited)


def photo_limit(caller: Caller, settings: Settings) -> tuple[UUID, int] | None:
    """The caller's key, and how many photos may be stored through it; None for any number."""
    most = caller.limits.max_photos or settings.key_max_photos
    return None if caller.key_id is None or most is None else (caller.key_id, most)


CHECK_PHOTO_QUOTA = Depends(_check_photo_quota)
ADMIT_JOB = Depends(_admit_job)
ADMIT_QUERY = Depends(_admit_query)


def _queue_full_error(what: str, waiting: int, most: int, per_second: float) -> TooManyRequests:
    excess = waiting - RETRY_TARGET_SHARE * most
    seconds = excess / per_second if per_second > 0 else MAX_RETRY_SECONDS
    return TooManyRequests(
        "queue_full",
        f"{waiting} {what} wait already, and {most} may. Come again after the time in Retry-After; "
        "more extractors make it shorter.",
        retry_after_seconds=math.ceil(min(max(seconds, 1), MAX_RETRY_SECONDS)),
        waiting=waiting,
        limit=most,
    )
