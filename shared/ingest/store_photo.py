"""From a received file to an acknowledged photo: its row and its job in one transaction.

The bytes lie in the object store before the transaction begins. Whoever finds the same bytes
already there, or loses the race for them, deletes its own object.

How many photos may be stored through one key. Deleted photos make room again.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, TypeVar
from uuid import UUID

from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from shared.catalog.api_keys import count_photos_of_key
from shared.catalog.maps import get_map
from shared.catalog.photos import Photo, PhotoRole, find_photo_by_sha256
from shared.catalog.session import Catalog
from shared.errors import Conflict, TooManyRequests
from shared.ids import new_id
from shared.ingest.photo_metadata import PhotoFields
from shared.ingest.validation import ValidatedPhoto
from shared.jobs import Job, JobKind, JobState, Priority, Wakeups
from shared.jobs.transitions import requeue_job

COORDINATE_TOLERANCE_DEGREES = 1e-7  # about a centimetre

Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class StoreResult:
    photo: Photo
    job: Job | None
    queued: bool
    """False: the same bytes were there already and need no work."""


BeforeCommit = Callable[[Session, StoreResult], StoreResult]
"""Writes down what was stored in the transaction that stores it, and hands it on."""


def store_photo(
    catalog: Catalog,
    hints: Wakeups,
    map_name: str,
    incoming: ValidatedPhoto,
    before_commit: BeforeCommit,
) -> StoreResult:
    """Acknowledge the photo, or the one with the same bytes that the map has already.

    Raises NotFound (`map_not_found`), and Conflict (`photo_differs`) when something else was said
    of that one.
    """
    stored = retry_on_conflict(lambda: _store(catalog, map_name, incoming, before_commit))
    if stored.queued:
        hints.send()
    return stored


def retry_on_conflict(store: Callable[[], Result]) -> Result:
    """`store`, a transaction with `insert_photo`; once more when it lost the race for its bytes."""
    try:
        return store()
    except IntegrityError:
        # The same bytes were committed between our look and our insert: look again.
        return store()


def insert_photo(
    session: Session, map_id: UUID, incoming: ValidatedPhoto, priority: Priority = Priority.UPLOAD
) -> StoreResult:
    """The photo's row and its job's, in the caller's transaction.

    Raises Conflict (`photo_differs`), and IntegrityError when the same bytes were committed since
    the transaction has looked for them.
    """
    received, header, fields = incoming.received, incoming.header, incoming.fields
    existing = find_photo_by_sha256(session, map_id, received.sha256)
    if existing is not None:
        return _match_existing_photo(session, existing, fields)
    photo_id, job_id = new_id(), new_id()
    said_where = fields.latitude is not None
    photo = Photo(
        id=photo_id,
        map_id=map_id,
        job_id=job_id,
        sha256=received.sha256,
        object_key=received.key,
        filename=received.filename,
        media_type=incoming.media_type,
        size_bytes=received.size_bytes,
        width=header.width,
        height=header.height,
        latitude=fields.latitude if said_where else header.latitude,
        longitude=fields.longitude if said_where else header.longitude,
        heading=fields.heading if fields.heading is not None else header.heading,
        captured_at=fields.captured_at or header.captured_at,
        place=fields.place,
        tags=fields.tags or [],
        attributes=fields.metadata or {},
        role=fields.role or PhotoRole.DATABASE,
        key_id=incoming.key_id,
    )
    session.add(photo)
    session.flush()
    job = Job(id=job_id, map_id=map_id, kind=JobKind.INDEX, priority=priority, photo_id=photo_id)
    session.add(job)
    session.flush()
    return StoreResult(photo, job, queued=True)


def _store(
    catalog: Catalog, map_name: str, incoming: ValidatedPhoto, keep: BeforeCommit
) -> StoreResult:
    with catalog.write() as session:
        return keep(session, insert_photo(session, get_map(session, map_name).id, incoming))


def _match_existing_photo(session: Session, photo: Photo, fields: PhotoFields) -> StoreResult:
    differing = _differing_fields(photo, fields)
    if differing:
        raise Conflict(
            "photo_differs",
            "The map has a photo with the same bytes of which something else was said: "
            f"{', '.join(differing)}. To change that: PATCH /api/v1/uploads/{photo.id}, or "
            "`placewise index --update`.",
            file_id=str(photo.id),
            differing=differing,
        )
    job = session.get(Job, photo.job_id, with_for_update=True) if photo.job_id else None
    if job is not None and job.state in (JobState.FAILED, JobState.CANCELLED):
        requeue_job(job)
        return StoreResult(photo, job, queued=True)
    return StoreResult(photo, job, queued=False)


def _differing_fields(photo: Photo, fields: PhotoFields) -> list[str]:
    """The fields that say something else of the photo than is stored."""
    stored = {
        "latitude": photo.latitude,
        "longitude": photo.longitude,
        "heading": photo.heading,
        "captured_at": photo.captured_at,
        "place": photo.place,
        "tags": photo.tags,
        "metadata": photo.attributes,
        "role": photo.role,
    }
    said = {name: getattr(fields, name) for name in stored}
    return [
        name
        for name, value in said.items()
        if value is not None and not _values_match(value, stored[name])
    ]


def _values_match(said: Any, stored: Any) -> bool:
    if isinstance(said, float) and isinstance(stored, float):
        return abs(said - stored) <= COORDINATE_TOLERANCE_DEGREES
    return bool(said == stored)


RECOUNT_SECONDS = 10.0
FULL_RECOUNT_SECONDS = 1.0  # once the limit is reached
QUOTA_RETRY_SECONDS = 3600


@dataclass(slots=True)
class KeyPhotos:
    """The photos of one key as this process knows them, under `lock`."""

    lock: threading.Lock = field(default_factory=threading.Lock)
    counted_at: float = -RECOUNT_SECONDS
    counted: int = 0
    """In the catalog, at `counted_at` (monotonic seconds)."""
    stored: int = 0
    """By this process since then, at most: bytes that were there already are no further photo."""


class PhotoQuota:
    """Counts the photos of each key. Thread-safe.

    One process never passes a limit: it stores the photos of a limited key one after the other.
    What other processes store is known after LOOK_SECONDS at the latest.
    """

    def __init__(self, catalog: Catalog) -> None:
        self._catalog = catalog
        self._keys: dict[UUID, KeyPhotos] = {}

    def check(self, key_id: UUID, most: int) -> None:
        """Refuse early, before a photo is received. TooManyRequests (`photo_quota_reached`)."""
        photos = self._keys.setdefault(key_id, KeyPhotos())
        with photos.lock:
            self._check(photos, key_id, most)

    @contextlib.contextmanager
    def place(self, key_id: UUID, most: int) -> Iterator[None]:
        """Room for one photo, which the block stores. TooManyRequests (`photo_quota_reached`)."""
        photos = self._keys.setdefault(key_id, KeyPhotos())
        with photos.lock:
            self._check(photos, key_id, most)
            photos.stored += 1  # also where the block raises: its transaction may be committed
            yield

    def _check(self, photos: KeyPhotos, key_id: UUID, most: int) -> None:
        age_seconds = time.monotonic() - photos.counted_at
        seems_full = photos.counted < most <= photos.counted + photos.stored
        if seems_full or age_seconds >= (
            RECOUNT_SECONDS if photos.counted < most else FULL_RECOUNT_SECONDS
        ):
            with self._catalog.read() as session:
                photos.counted = count_photos_of_key(session, key_id, most)
            photos.counted_at, photos.stored = time.monotonic(), 0
        if photos.counted >= most:
            raise TooManyRequests(
                "photo_quota_reached",
                f"{most} photos are stored through this key, and no more may be. Delete some, or "
                "ask an admin for a key with a higher limit.",
                retry_after_seconds=QUOTA_RETRY_SECONDS,
                limit=most,
            )
