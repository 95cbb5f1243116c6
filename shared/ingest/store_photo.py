"""Storing a validated photo: its row and its job in one transaction, and the photo quota of keys.

The bytes are in the object store before the transaction begins. A caller whose photo already
exists, or that loses a race for the same bytes, deletes its own object.
"""

from __future__ import annotations

import contextlib
import functools
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, cast
from uuid import UUID

from sqlalchemy import Executable, Table, and_, bindparam, insert, select
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session

from shared.catalog.api_keys import count_photos_of_key
from shared.catalog.database.session import Catalog
from shared.catalog.jobs import UNFINISHED_STATES
from shared.catalog.maps import Map, get_map, increment_map_version, lock_map
from shared.catalog.photos import Photo, PhotoRole, find_same_photo
from shared.errors import Conflict, TooManyRequests
from shared.ids import new_id
from shared.imaging.photo_header import PhotoHeader
from shared.ingest.photo_metadata import PhotoFields
from shared.ingest.validation import ValidatedPhoto
from shared.jobs import Job, JobKind, JobState, Priority
from shared.jobs.transitions import requeue_job_as_new

COORDINATE_TOLERANCE_DEGREES = 1e-7  # about a centimetre
METADATA_OF_FILES = ("latitude", "longitude", "altitude", "heading", "captured_at", "focal_length")
FILE_COLUMNS = ("sha256", "object_key", "filename", "size_bytes")


@dataclass(frozen=True, slots=True)
class StoreResult:
    """The stored photo and its job; new ones are not attached to the session."""

    photo: Photo
    job: Job | None
    queued: bool
    """Whether the job was queued, so that extractors are to be woken after the commit."""
    already_there: bool
    """Whether the map had the picture."""
    updated: tuple[str, ...] = ()
    """Values of a photo of the map that the new metadata of its file has set"""
    unused_key: str | None = None
    """Object to delete after the commit: the received bytes of a photo of the map, or the file that
    they replace"""


def insert_photo(
    session: Session,
    map_: UUID | str,
    incoming: ValidatedPhoto,
    priority: Priority = Priority.UPLOAD,
) -> StoreResult:
    """Insert the rows of a photo and its job, or return the map's photo with the same picture.

    A file of that picture with new metadata replaces the photo's file, and updates its values.

    Args:
        map_: id of the map, or the name of a live one.

    Raises:
        NotFound: `map_not_found`.
        Conflict: `photo_differs` when the photo exists and the sent fields differ from its values.
    """
    values = _photo_values(incoming)
    dialect = session.get_bind().dialect.name
    statement = _insert_statement(dialect, tuple(values), isinstance(map_, str))
    while (row := session.execute(statement, {**values, "map_": map_}).one_or_none()) is None:
        map_id = get_map(session, map_).id if isinstance(map_, str) else map_
        existing = find_same_photo(
            session, map_id, incoming.received.sha256, incoming.picture_sha256
        )
        if existing is not None and (
            result := _match_existing_photo(session, existing, incoming, values)
        ):
            return result
        # PostgreSQL: the photo with the same bytes was deleted after the INSERT had seen it.
    photo = Photo(**values, map_id=row.map_id, uploaded_at=row.uploaded_at)
    job_values = {
        "id": photo.job_id,
        "map_id": photo.map_id,
        "kind": JobKind.INDEX,
        "state": JobState.QUEUED,
        "priority": priority,
        "photo_id": photo.id,
    }
    session.execute(_INSERT_JOB, job_values)
    return StoreResult(photo, Job(**job_values), queued=True, already_there=False)


def _photo_values(incoming: ValidatedPhoto) -> dict[str, Any]:
    received, header, fields = incoming.received, incoming.header, incoming.fields
    has_coordinates = fields.latitude is not None
    return {
        "id": new_id(),
        "job_id": new_id(),
        "sha256": received.sha256,
        "picture_sha256": incoming.picture_sha256,
        "object_key": received.key,
        "filename": received.filename,
        "relative_path": fields.relative_path,
        "media_type": incoming.media_type,
        "size_bytes": received.size_bytes,
        "width": header.width,
        "height": header.height,
        "latitude": fields.latitude if has_coordinates else header.latitude,
        "longitude": fields.longitude if has_coordinates else header.longitude,
        "altitude": fields.altitude if fields.altitude is not None else header.altitude,
        "heading": fields.heading if fields.heading is not None else header.heading,
        "focal_length": header.focal_length,
        "captured_at": fields.captured_at or header.captured_at,
        "capture": describe_capture(header, time_was_sent=fields.captured_at is not None),
        "place": fields.place,
        "tags": fields.tags or [],
        "attributes": fields.metadata or {},
        "role": fields.role or PhotoRole.DATABASE,
        "key_id": incoming.key_id,
    }


def describe_capture(header: PhotoHeader, time_was_sent: bool) -> dict[str, Any]:
    """Return what locating a photo takes beside its time, as JSON.

    Args:
        time_was_sent: Whether its time is not that of the header: such a time is UTC.
    """
    offset = header.clock_offset
    return {
        "camera": header.camera,
        "camera_is_unique": header.camera_is_unique,
        "time_zone_is_known": time_was_sent or header.time_zone_is_known,
        "clock_offset_seconds": None if offset is None or time_was_sent else offset.total_seconds(),
        "gps_error": header.gps_error,
    }


# Core instead of `session.add`: the unit of work takes more time than both statements.
_INSERT_JOB = insert(cast(Table, Job.__table__))


@functools.cache
def _insert_statement(dialect: str, names: tuple[str, ...], by_name: bool) -> Executable:
    """Return the insert of a photo into the map `map_`, unless that has the same picture."""
    columns = {name: Photo.__mapper__.columns[name] for name in names}
    values = [bindparam(name, type_=column.type) for name, column in columns.items()]
    is_map = Map.id == bindparam("map_")
    if by_name:
        is_map = and_(Map.name == bindparam("map_"), Map.deleted_at.is_(None))
    table = cast(Table, Photo.__table__)
    insert_into = sqlite.insert if dialect == "sqlite" else postgresql.insert
    return (
        insert_into(table)
        .from_select([*columns.values(), table.c.map_id], select(*values, Map.id).where(is_map))
        .on_conflict_do_nothing()
        .returning(table.c.map_id, table.c.uploaded_at)
    )


def _match_existing_photo(
    session: Session, photo: Photo, incoming: ValidatedPhoto, values: dict[str, Any]
) -> StoreResult | None:
    """Return the photo, updated by new metadata of its file; None if it was deleted meanwhile."""
    differing = _differing_fields(photo, incoming.fields)
    if differing:
        raise Conflict(
            "photo_differs",
            "The map already has the same image with different metadata: "
            f"{', '.join(differing)}. To change it: PATCH /api/v1/uploads/{photo.id}?map="
            f"{session.get_one(Map, photo.map_id).name}, or `placewise index --update`.",
            file_id=str(photo.id),
            differing=differing,
        )
    if photo.relative_path is None:  # stored before paths were kept, or uploaded without its folder
        photo.relative_path = incoming.fields.relative_path
    job = session.get(Job, photo.job_id, with_for_update=True) if photo.job_id else None
    unused_key = incoming.received.key
    updated: tuple[str, ...] = ()
    if photo.sha256 != incoming.received.sha256:  # the same picture with other metadata
        updated = tuple(
            name
            for name in METADATA_OF_FILES
            if values[name] is not None and not _values_match(values[name], getattr(photo, name))
        )
    if updated:
        lock_map(session, photo.map_id)
        session.refresh(photo)
        if photo.deleted_at is not None:
            return None
        for name in updated:
            setattr(photo, name, values[name])
        # An extractor may be reading the present file; the next upload replaces it.
        if job is None or job.state not in UNFINISHED_STATES:
            unused_key = photo.object_key
            for name in FILE_COLUMNS:
                setattr(photo, name, values[name])
        photo.changed_version = increment_map_version(session, photo.map_id)
    queued = job is not None and job.state in (JobState.FAILED, JobState.CANCELLED)
    if job is not None and queued:
        requeue_job_as_new(job)
    # A worker that stores its own object again finds it under the photo's key.
    unused = None if photo.object_key == unused_key else unused_key
    return StoreResult(photo, job, queued, True, updated, unused)


def _differing_fields(photo: Photo, fields: PhotoFields) -> list[str]:
    """Return the sent fields whose values differ from the stored ones."""
    stored = {
        "latitude": photo.latitude,
        "longitude": photo.longitude,
        "altitude": photo.altitude,
        "heading": photo.heading,
        "captured_at": photo.captured_at,
        "place": photo.place,
        "tags": photo.tags,
        "metadata": photo.attributes,
        "role": photo.role,
    }
    sent = {name: getattr(fields, name) for name in stored}
    return [
        name
        for name, value in sent.items()
        if value is not None and not _values_match(value, stored[name])
    ]


def _values_match(sent: Any, stored: Any) -> bool:
    if isinstance(sent, float) and isinstance(stored, float):
        return abs(sent - stored) <= COORDINATE_TOLERANCE_DEGREES
    return bool(sent == stored)


RECOUNT_SECONDS = 10.0
FULL_RECOUNT_SECONDS = 1.0  # once the limit is reached
QUOTA_RETRY_SECONDS = 3600


@dataclass(slots=True)
class KeyPhotos:
    """Cached photo count of one key, guarded by `lock`."""

    lock: threading.Lock = field(default_factory=threading.Lock)
    counted_at: float = -RECOUNT_SECONDS
    counted: int = 0
    """Count in the catalog at `counted_at` (monotonic seconds)."""
    stored: int = 0
    """Upper bound of the photos stored by this process since then (an existing one adds none)."""


class PhotoQuota:
    """The quota of stored photos per key. Thread-safe.

    A single process never exceeds a limit, because it stores the photos of a limited key
    sequentially. Photos of other processes are counted within RECOUNT_SECONDS. Deleting photos
    frees quota.
    """

    def __init__(self, catalog: Catalog) -> None:
        self._catalog = catalog
        self._keys: dict[UUID, KeyPhotos] = {}

    def check(self, key_id: UUID, limit: int) -> None:
        """Raise TooManyRequests (`photo_quota_reached`) before a photo is received."""
        photos = self._keys.setdefault(key_id, KeyPhotos())
        with photos.lock:
            self._check(photos, key_id, limit)

    @contextlib.contextmanager
    def reserve(self, key_id: UUID, limit: int) -> Iterator[None]:
        """Reserve quota for one photo that the block stores.

        Raises:
            TooManyRequests: `photo_quota_reached`.
        """
        photos = self._keys.setdefault(key_id, KeyPhotos())
        with photos.lock:
            self._check(photos, key_id, limit)
            photos.stored += 1  # even if the block raises: its transaction may be committed
            yield

    def _check(self, photos: KeyPhotos, key_id: UUID, limit: int) -> None:
        age_seconds = time.monotonic() - photos.counted_at
        seems_full = photos.counted < limit <= photos.counted + photos.stored
        if seems_full or age_seconds >= (
            RECOUNT_SECONDS if photos.counted < limit else FULL_RECOUNT_SECONDS
        ):
            with self._catalog.read() as session:
                photos.counted = count_photos_of_key(session, key_id, limit)
            photos.counted_at, photos.stored = time.monotonic(), 0
        if photos.counted >= limit:
            raise TooManyRequests(
                "photo_quota_reached",
                f"The API key has reached its limit of {limit} photos; tracks and their frames "
                "count as well. Delete some, or ask an administrator for a key with a higher "
                "limit.",
                retry_after_seconds=QUOTA_RETRY_SECONDS,
                limit=limit,
            )
