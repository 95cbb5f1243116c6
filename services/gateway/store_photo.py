"""From a received file to an acknowledged photo: its row and its job in one transaction.

The bytes lie in the object store before the transaction begins. Whoever finds the same bytes
already there, or loses the race for them, deletes its own object.
"""

from __future__ import annotations

from dataclasses import dataclass
from uuid import UUID

from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from services.gateway.context import API, Gateway
from services.gateway.photo_fields import PhotoFields
from services.gateway.photo_header import PhotoHeader
from services.gateway.receive import Received
from shared.catalog.maps import get_map
from shared.catalog.photos import Photo, PhotoRole, find_live_by_sha256
from shared.errors import Conflict, PlacewiseError
from shared.ids import new_id
from shared.jobs import Job, JobKind, JobState, Priority
from shared.jobs.finish import requeue

SAME_DEGREES = 1e-7  # about a centimetre


@dataclass(frozen=True, slots=True)
class Stored:
    photo: Photo
    job: Job | None
    queued: bool
    """False: the same bytes were there already and need no work."""


@dataclass(frozen=True, slots=True)
class Incoming:
    """A checked photo whose bytes lie in the object store."""

    received: Received
    media_type: str
    header: PhotoHeader
    fields: PhotoFields


def store_photo(gateway: Gateway, map_name: str, incoming: Incoming) -> Stored:
    """Acknowledge the photo, or the one with the same bytes that the map has already.

    Raises Conflict (`photo_differs`) when that one has other coordinates or another place.
    """
    try:
        stored = _store(gateway, map_name, incoming)
    except IntegrityError:
        # The same bytes were committed between our look and our insert: look again.
        stored = _store(gateway, map_name, incoming)
    if stored.queued:
        gateway.hints.send()
    return stored


def _store(gateway: Gateway, map_name: str, incoming: Incoming) -> Stored:
    received, header, fields = incoming.received, incoming.header, incoming.fields
    with gateway.catalog.write() as session:
        map_ = get_map(session, map_name)
        existing = find_live_by_sha256(session, map_.id, received.sha256)
        if existing is not None:
            return _same_again(session, existing, fields)
        photo_id, job_id = new_id(), new_id()
        said_where = fields.latitude is not None
        photo = Photo(
            id=photo_id,
            map_id=map_.id,
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
        )
        session.add(photo)
        session.flush()
        job = Job(
            id=job_id,
            map_id=map_.id,
            kind=JobKind.INDEX,
            priority=Priority.UPLOAD,
            photo_id=photo_id,
        )
        session.add(job)
        session.flush()
        return Stored(photo, job, queued=True)


def _same_again(session: Session, photo: Photo, fields: PhotoFields) -> Stored:
    if _says_otherwise(photo, fields):
        raise _differs(photo.id)
    job = session.get(Job, photo.job_id, with_for_update=True) if photo.job_id else None
    if job is not None and job.state in (JobState.FAILED, JobState.CANCELLED):
        requeue(job)
        return Stored(photo, job, queued=True)
    return Stored(photo, job, queued=False)


def _says_otherwise(photo: Photo, fields: PhotoFields) -> bool:
    if fields.place is not None and fields.place != photo.place:
        return True
    if fields.role is not None and fields.role != photo.role:
        return True
    if fields.latitude is None or fields.longitude is None:
        return False
    if photo.latitude is None or photo.longitude is None:
        return True
    return (
        abs(photo.latitude - fields.latitude) > SAME_DEGREES
        or abs(photo.longitude - fields.longitude) > SAME_DEGREES
    )


def _differs(photo_id: UUID) -> PlacewiseError:
    return Conflict(
        "photo_differs",
        "The map has a photo with the same bytes at other coordinates, with another place or role. "
        f"To change them: PATCH {API}/uploads/{photo_id}.",
        file_id=str(photo_id),
    )
