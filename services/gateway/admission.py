"""Admission control: refuses requests before the job queue, the disk or the memory is full.

Routes that queue jobs check for room before they read the body:

    @router.post("/evaluations", dependencies=[ADMIT_JOB])

and those that receive a file limit the concurrent uploads:

    with admission.admit_upload(UploadKind.UPLOAD, request):

Query photos have separate limits, so that queued uploads do not block queries.
"""

from __future__ import annotations

import contextlib
import math
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import AbstractContextManager
from enum import StrEnum
from typing import Annotated, NoReturn
from uuid import UUID

from fastapi import Depends, Request
from starlette.concurrency import run_in_threadpool

from services.gateway.authentication import Caller, get_caller
from services.gateway.dependencies import GatewayContext, get_map_name
from services.http_connections import address_group
from shared.catalog.database.session import Catalog
from shared.config.disk_space import QUERY_SHARE, DiskSpace
from shared.config.settings import Settings
from shared.errors import TooManyRequests
from shared.ingest.store_photo import PhotoQuota
from shared.jobs.queue_depth import PolledValue, QueueDepth, measure_queue_depth

ADMISSION_POLL_SECONDS = 1.0
RETRY_TARGET_SHARE = 0.9  # Retry-After: when the queue has shrunk to this share of its limit
MAX_RETRY_SECONDS = 60
UNKNOWN_RATE_RETRY_SECONDS = 5  # Retry-After while no job has finished within the last minute
UPLOAD_RETRY_SECONDS = 1
MAX_SMOOTHED_TRACKS = 2  # at the same time: each competes with all other requests for the CPU
SMOOTHING_RETRY_SECONDS = 2


class _ConcurrencyLimit:
    """Limits concurrent requests of one kind. Must be used on the event loop only."""

    def __init__(self, what: str, code: str, *, total: int, retry_after_seconds: int) -> None:
        """Create the limit for all callers together; one API key or address may use half of it.

        `what` names the requests, and the setting of the limit, in error messages with `code`.
        """
        self._what = what
        self._code = code
        self._total = total
        self._per_caller = _half(total)
        self._retry_after_seconds = retry_after_seconds
        self._count_by_caller: Counter[str] = Counter()
        self.count = 0

    @contextlib.contextmanager
    def hold(self, request: Request) -> Iterator[None]:
        """Count the request while the block runs.

        Raises:
            TooManyRequests: The total limit or the limit of the caller is reached.
        """
        callers = _callers(request)
        if self.count >= self._total:
            self._refuse(f"{self._total} {self._what}")
        for caller in callers:
            if self._count_by_caller[caller] >= self._per_caller:
                self._refuse(f"{self._per_caller} {self._what} of this {caller.partition(' ')[0]}")
        self.count += 1
        self._count_by_caller.update(callers)
        try:
            yield
        finally:
            self.count -= 1
            self._count_by_caller.subtract(callers)
            self._count_by_caller += Counter()  # removes callers whose count is 0

    def _refuse(self, handled: str) -> NoReturn:
        raise TooManyRequests(
            self._code,
            f"The server is already handling {handled}. Try again in a moment.",
            retry_after_seconds=self._retry_after_seconds,
        )


def _half(limit: int) -> int:
    """The part of a limit that one caller or one map may use."""
    return math.ceil(limit / 2)


def _callers(request: Request) -> list[str]:
    """The request's key and address. ADMIN_KEY has no key id, so it is counted by address only."""
    key_id = get_caller(request).key_id
    callers = [] if key_id is None else [f"key {key_id}"]
    if request.client is not None:
        callers.append(f"address {address_group(request.client.host)}")
    return callers


class UploadKind(StrEnum):
    UPLOAD = "uploads"
    QUERY = "query photos"


class AdmissionControl:
    """Decides whether this gateway accepts another job, query or upload.

    Thread-safe, except `admit_upload`. The depth of the queue is polled about once a second; jobs
    that were admitted since the last poll are counted in addition.
    """

    def __init__(self, catalog: Catalog, settings: Settings) -> None:
        self._catalog = catalog
        self._settings = settings
        self.disk = DiskSpace(settings)
        self._queue_depth = PolledValue(self._measure_queue_depth, ADMISSION_POLL_SECONDS)
        self._admitted: Counter[str | None] = Counter()  # since the last poll; None: queries
        self._admitted_lock = threading.Lock()
        self._active_uploads = {
            kind: _ConcurrencyLimit(
                f"{kind} (MAX_CONCURRENT_UPLOADS)",
                "too_many_uploads",
                total=settings.max_concurrent_uploads,
                retry_after_seconds=UPLOAD_RETRY_SECONDS,
            )
            for kind in UploadKind
        }
        self.smoothed_tracks = _ConcurrencyLimit(
            "requests for smoothed tracks",
            "too_many_smoothed_tracks",
            total=MAX_SMOOTHED_TRACKS,
            retry_after_seconds=SMOOTHING_RETRY_SECONDS,
        )

    def admit_job(self, map_name: str) -> None:
        """Admit a job of the map, and the data that it stores.

        Raises:
            TooManyRequests: `queue_full`.
            StorageFull: `disk_full`.
        """
        self.disk.check()
        depth, limit = self.queue_depth(), self._settings.max_queued_jobs
        with self._admitted_lock:
            of_map = depth.jobs_by_map.get(map_name, 0) + self._admitted[map_name]
            _check_queue("jobs", depth.jobs + self._admitted_jobs(), limit, depth)
            _check_queue(f"jobs of the map {map_name!r}", of_map, _half(limit), depth)
            self._admitted[map_name] += 1

    def check_queue(self) -> None:
        """Check that the queue has room for jobs of some map.

        Raises:
            TooManyRequests: `queue_full`.
        """
        depth = self.queue_depth()
        with self._admitted_lock:
            queued = depth.jobs + self._admitted_jobs()
        _check_queue("jobs", queued, self._settings.max_queued_jobs, depth)

    def _admitted_jobs(self) -> int:
        """Number of jobs admitted since the last poll; the caller holds the lock."""
        return sum(count for name, count in self._admitted.items() if name is not None)

    def admit_query(self) -> None:
        """Admit a query photo.

        Queries are admitted until less than QUERY_SHARE of MIN_FREE_BYTES is free, so they still
        work while uploads are refused because the disk is full.

        Raises:
            TooManyRequests: `queue_full`.
            StorageFull: `disk_full`.
        """
        self.disk.check(QUERY_SHARE)
        depth, limit = self.queue_depth(), self._settings.max_queued_queries
        with self._admitted_lock:
            _check_queue("query photos", depth.queries + self._admitted[None], limit, depth)
            self._admitted[None] += 1

    def admit_upload(self, kind: UploadKind, request: Request) -> AbstractContextManager[None]:
        """Context manager that counts an upload while its file is received.

        Each upload buffers a part of its file in memory, so concurrent uploads are limited: in
        total, per key and per address. Must be used on the event loop only.

        Raises:
            TooManyRequests: `too_many_uploads`.
        """
        return self._active_uploads[kind].hold(request)

    def active_uploads(self, kind: UploadKind) -> int:
        """Return the number of uploads that are being received."""
        return self._active_uploads[kind].count

    def queue_depth(self) -> QueueDepth:
        """Return the depth of the queue, at most about a second old."""
        return self._queue_depth.get()

    def _measure_queue_depth(self) -> QueueDepth:
        limit = max(self._settings.max_queued_jobs, self._settings.max_queued_queries)
        with self._admitted_lock:
            self._admitted.clear()  # before the poll: a job may be counted twice, never missed
        with self._catalog.read() as session:
            return measure_queue_depth(session, limit)


async def _get_admission_control(request: Request) -> AdmissionControl:
    """Dependency that returns the admission control of the application."""
    admission: AdmissionControl = request.app.state.admission
    return admission


AdmissionDep = Annotated[AdmissionControl, Depends(_get_admission_control)]


# These read `app.state` instead of declaring what they use: FastAPI resolves each dependency of a
# dependency for every request, which takes as long as admitting it.


def _admit_job(request: Request) -> None:
    request.app.state.admission.admit_job(get_map_name(request))


def _admit_query(request: Request) -> None:
    request.app.state.admission.admit_query()


def _check_disk(request: Request) -> None:
    request.app.state.admission.disk.check()


async def _check_photo_quota(request: Request) -> None:
    gateway: GatewayContext = request.app.state.gateway
    key_limit = get_photo_limit(get_caller(request), gateway.settings)
    if key_limit is not None:
        quota: PhotoQuota = request.app.state.photo_quota
        key_id, limit = key_limit
        await run_in_threadpool(quota.check, key_id, limit)


def reserve_photo_quota(request: Request, settings: Settings) -> AbstractContextManager[None]:
    """Return a context manager in which a photo of the caller is stored.

    Entering it raises TooManyRequests (`photo_quota_reached`) if the quota of the key is used up.
    """
    quota: PhotoQuota = request.app.state.photo_quota
    key_limit = get_photo_limit(get_caller(request), settings)
    return contextlib.nullcontext() if key_limit is None else quota.reserve(*key_limit)


def get_photo_limit(caller: Caller, settings: Settings) -> tuple[UUID, int] | None:
    """Return the caller's key and its maximum number of photos; None if it is unlimited."""
    limit = caller.limits.max_photos or settings.key_max_photos
    return None if caller.key_id is None or limit is None else (caller.key_id, limit)


CHECK_PHOTO_QUOTA = Depends(_check_photo_quota)
ADMIT_JOB = Depends(_admit_job)
ADMIT_QUERY = Depends(_admit_query)
CHECK_DISK = Depends(_check_disk)
"""For requests that store rows, but queue no job: StorageFull (`disk_full`)."""


def _check_queue(what: str, queued: int, limit: int, depth: QueueDepth) -> None:
    if queued < limit:
        return
    excess, per_second = queued - RETRY_TARGET_SHARE * limit, depth.finished_per_second
    seconds = excess / per_second if per_second > 0 else UNKNOWN_RATE_RETRY_SECONDS
    raise TooManyRequests(
        "queue_full",
        f"The queue is full: {queued} {what} are waiting, the limit is {limit}. Retry after the "
        "seconds in Retry-After. More extractors process the queue faster.",
        retry_after_seconds=math.ceil(min(max(seconds, 1), MAX_RETRY_SECONDS)),
        waiting=queued,
        limit=limit,
    )
