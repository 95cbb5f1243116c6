"""Describing photos again whose descriptors are lost. Their originals are all that it needs."""

from __future__ import annotations

from functools import partial
from uuid import UUID

from sqlalchemy import delete, select
from sqlalchemy.orm import Session

from shared.catalog.base import db_now
from shared.catalog.chunks import Chunk, Descriptor
from shared.catalog.generations import GenerationState, lock_generation
from shared.catalog.maps import increment_map_version, lock_map
from shared.catalog.photos import Photo, get_live_photos
from shared.catalog.session import Catalog
from shared.ids import new_id
from shared.integrity.report import IntegrityReport
from shared.jobs.finish import requeue_job
from shared.jobs.hints import Wakeups
from shared.jobs.table import UNFINISHED_STATES, Job, JobKind, Priority


def repair_descriptors(catalog: Catalog, hints: Wakeups, report: IntegrityReport) -> int:
    """Queue the photos of damaged chunks, and those without a descriptor; how many.

    The chunks' rows leave the catalog in the same transaction: until a photo is described again, it
    is not found, and nothing wrong is.
    """
    queued = 0
    for chunk_id in dict.fromkeys(f.chunk_id for f in report.faults if f.chunk_id is not None):
        queued += catalog.run(partial(give_up_chunk, chunk_id=chunk_id))
    lost = [fault.photo_id for fault in report.faults if fault.photo_id is not None]
    if lost:
        queued += catalog.run(lambda session: _queue_photos(session, lost))
    if queued:
        hints.send()
    return queued


def give_up_chunk(session: Session, chunk_id: UUID) -> int:
    """Let the chunk's photos be described again, and its rows leave the catalog; how many."""
    chunk = session.get(Chunk, chunk_id)
    if chunk is None or chunk.superseded_at is not None:
        return 0  # merged or mended meanwhile
    generation = lock_generation(session, chunk.generation_id)
    lock_map(session, generation.map_id)
    photo_ids = list(
        session.scalars(select(Descriptor.photo_id).where(Descriptor.chunk_id == chunk_id))
    )
    session.execute(delete(Descriptor).where(Descriptor.chunk_id == chunk_id))
    chunk.superseded_at = db_now()
    increment_map_version(session, generation.map_id)
    if generation.state == GenerationState.ACTIVE:
        return _queue_photos(session, photo_ids)
    # Of one that is being built: the steward queues what has neither a row nor a job there.
    session.execute(
        delete(Job).where(
            Job.kind == JobKind.REINDEX,
            Job.generation_id == generation.id,
            Job.photo_id.in_(photo_ids),
        )
    )
    return len(photo_ids)


def _queue_photos(session: Session, photo_ids: list[UUID]) -> int:
    live = get_live_photos(session, photo_ids)
    for photo in live.values():
        _queue_photo(session, photo)
    return len(live)


def _queue_photo(session: Session, photo: Photo) -> None:
    job = session.get(Job, photo.job_id, with_for_update=True) if photo.job_id else None
    if job is not None and job.state in UNFINISHED_STATES:
        return
    if job is not None:
        requeue_job(job)
        return
    photo.job_id = new_id()
    session.add(
        Job(
            id=photo.job_id,
            map_id=photo.map_id,
            kind=JobKind.INDEX,
            priority=Priority.UPLOAD,
            photo_id=photo.id,
        )
    )
