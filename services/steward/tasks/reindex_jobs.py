"""Reindex jobs of model changes: one for each photo that a new generation has to describe.

Photos are queued chunk by chunk of the active generation, without the map's lock, and the chunks
that are done are remembered. The photos whose description failed are queued as well, once. Jobs of
ended model changes are cancelled or deleted, and failed ones become the jobs of their photos.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from uuid import UUID

from sqlalchemy import Select, delete, insert, or_, select, update
from sqlalchemy.orm import Session

from services.steward.periodic_tasks import periodic_task
from shared.catalog.chunks import IDS_PER_QUERY, Chunk, Descriptor, select_failed_photos
from shared.catalog.database.base import affected_rows
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation, GenerationState, active_generation
from shared.catalog.jobs import UNFINISHED_STATES, WaitingFor
from shared.catalog.maps import Map
from shared.catalog.photos import Photo
from shared.jobs import Job, JobKind, JobState
from shared.jobs.transitions import CANCELLED_PER_TRANSACTION, cancel_jobs, succeed_job

# What a model change waits for that the steward advances.
ADVANCED_WAITS = (WaitingFor.DESCRIPTORS, WaitingFor.SEARCH)

REINDEX_JOBS_PER_TRANSACTION = 500
DELETED_JOBS_PER_TRANSACTION = 1000
SLICE_SECONDS = 0.5  # of one run for each model change, so that other tasks are not delayed

QueuedChunks = dict[UUID, set[UUID]]
"""Building generation -> chunks of the active one whose photos have all been queued.

The id of the active generation itself stands for the photos whose description failed.
"""


def queue_missing_photos(
    catalog: Catalog, job: Job, generation: Generation, queued_chunks: set[UUID]
) -> tuple[int, bool]:
    """Queue a reindex job for each photo without one, for about SLICE_SECONDS.

    Every call reaches one more source of photos, however slow the catalog is. Adds those whose
    photos are all queued to `queued_chunks`.

    Returns:
        The number of queued jobs, and whether every source was reached.
    """
    deadline = time.monotonic() + SLICE_SECONDS
    queued = _queue_photos(catalog, job, generation, _photos_of_cancelled_jobs(generation.id))
    with catalog.read() as session:
        sources = _photo_sources(session, generation.map_id)
    queued_chunks.intersection_update(sources)
    for source_id in sorted(sources.keys() - queued_chunks):
        queued += _queue_photos(catalog, job, generation, sources[source_id])
        queued_chunks.add(source_id)
        if time.monotonic() > deadline:
            break
    return queued, sources.keys() == queued_chunks


def _queue_photos(
    catalog: Catalog, job: Job, generation: Generation, photo_ids: Select[UUID]
) -> int:
    """Queue a reindex job for each missing one of the photos; return the number of jobs."""
    with catalog.read() as session:
        missing = _find_missing(session, generation.id, session.scalars(photo_ids).all())
    reindex = {"kind": JobKind.REINDEX, "map_id": generation.map_id, "generation_id": generation.id}
    queued = 0
    for begin in range(0, len(missing), REINDEX_JOBS_PER_TRANSACTION):
        batch = missing[begin : begin + REINDEX_JOBS_PER_TRANSACTION]
        with catalog.write() as session:
            # The new jobs refer to the map, which PostgreSQL locks for that. Finishing a model
            # change locks the map before the job, so the same order prevents a deadlock.
            reference = select(Map.id).where(Map.id == generation.map_id)
            session.execute(reference.with_for_update(read=True, key_share=True))
            # Of several stewards, one queues at a time; and none for a cancelled model change.
            current = session.get_one(Job, job.id, with_for_update=True)
            if current.waiting_for not in ADVANCED_WAITS:
                break
            still_missing = _find_missing(session, generation.id, batch)
            if still_missing:
                session.execute(
                    insert(Job), [{**reindex, "photo_id": id_} for id_ in still_missing]
                )
            queued += len(still_missing)
    return queued


def has_missing_photos(session: Session, generation: Generation, queued_chunks: set[UUID]) -> bool:
    """Return whether a live photo of the active generation has no descriptor or job in this one.

    Reads the chunks that are not in `queued_chunks` only, and the photos of cancelled jobs.
    """
    sources = _photo_sources(session, generation.map_id)
    new = [sources[source_id] for source_id in sources.keys() - queued_chunks]
    return any(
        _find_missing(session, generation.id, session.scalars(photo_ids).all())
        for photo_ids in (_photos_of_cancelled_jobs(generation.id), *new)
    )


def _find_missing(session: Session, generation_id: UUID, photo_ids: Sequence[UUID]) -> list[UUID]:
    """Return the live ones of the photos without a descriptor or a job in the generation.

    Rows are looked up by photo and not by generation: PostgreSQL's planner underestimates how many
    rows a generation has that is being built, and would read all of them for each photo.
    """
    missing: list[UUID] = []
    for begin in range(0, len(photo_ids), IDS_PER_QUERY):
        batch = photo_ids[begin : begin + IDS_PER_QUERY]
        live = select(Photo.id).where(Photo.id.in_(batch), Photo.deleted_at.is_(None))
        described = select(Descriptor.photo_id, Descriptor.generation_id).where(
            Descriptor.photo_id.in_(batch)
        )
        queued = select(Job.photo_id, Job.generation_id).where(
            Job.photo_id.in_(batch), Job.state != JobState.CANCELLED
        )
        present = {
            photo_id
            for statement in (described, queued)
            for photo_id, of_generation in session.execute(statement)
            if of_generation == generation_id
        }
        missing += [photo_id for photo_id in session.scalars(live) if photo_id not in present]
    return missing


def _photos_of_cancelled_jobs(generation_id: UUID) -> Select[UUID]:
    """Select the photos whose reindex jobs were cancelled: they may be missing again."""
    return (
        select(Photo.id)
        .join(Job, Job.photo_id == Photo.id)
        .where(
            Job.generation_id == generation_id,
            Job.state == JobState.CANCELLED,
            Job.kind == JobKind.REINDEX,
        )
    )


def _photo_sources(session: Session, map_id: UUID) -> dict[UUID, Select[UUID]]:
    """Return the selections of photos that a new generation describes, by their `QueuedChunks` id.

    The recorded failures of earlier generations are retried, because the new one may describe the
    photos.
    """
    active = active_generation(session, map_id)
    assert active is not None, "a generation is built only while another is active"
    live = select(Chunk.id).where(Chunk.generation_id == active.id, Chunk.superseded_at.is_(None))
    described = select(Descriptor.photo_id)
    chunks = {id_: described.where(Descriptor.chunk_id == id_) for id_ in session.scalars(live)}
    return {active.id: select_failed_photos(map_id), **chunks}


@periodic_task(0.5)
def cancel_jobs_of_abandoned_generations(catalog: Catalog) -> None:
    """Cancel the reindex jobs of model changes that were cancelled or failed.

    Works for up to SLICE_SECONDS: a model change has as many jobs as its map has photos.
    """
    unfinished = (
        select(Job.id)
        .join(Generation, Generation.id == Job.generation_id)
        .where(
            Generation.state == GenerationState.ABANDONED,
            Job.state.in_(UNFINISHED_STATES),
            Job.kind == JobKind.REINDEX,
        )
        .limit(CANCELLED_PER_TRANSACTION)
    )
    deadline = time.monotonic() + SLICE_SECONDS
    while time.monotonic() < deadline:
        with catalog.read() as session:
            job_ids = session.scalars(unfinished).all()
        if not job_ids:
            return
        with catalog.write() as session:
            cancel_jobs(session, Job.id.in_(job_ids))


def settle_photo_jobs(catalog: Catalog) -> None:
    """Set the photos' jobs to what active generations have made of the photos.

    A failed reindex job becomes its photo's job, which shows the error, unless the photo was queued
    again since. A photo's failed job succeeds if a later generation describes the photo.
    """
    _adopt_failed_reindex_jobs(catalog)
    described = (
        select(Job, Generation.id)
        .join(Generation, Generation.map_id == Job.map_id)
        .join(Photo, (Photo.id == Job.photo_id) & (Photo.job_id == Job.id))
        .join(Descriptor, Descriptor.photo_id == Photo.id)
        .where(
            Job.state == JobState.FAILED,
            Generation.state == GenerationState.ACTIVE,
            Descriptor.generation_id == Generation.id,
            Job.finished_at < Generation.activated_at,
        )
        .limit(REINDEX_JOBS_PER_TRANSACTION)
    )
    while True:
        with catalog.write() as session:
            jobs = session.execute(described.with_for_update(of=Job)).all()
            for job, generation_id in jobs:
                job.progress_failed = 0
                file_id = str(job.photo_id)
                succeed_job(job, {"file_id": file_id, "generation_id": str(generation_id)})
        if len(jobs) < REINDEX_JOBS_PER_TRANSACTION:
            return


def _adopt_failed_reindex_jobs(catalog: Catalog) -> None:
    failed = (
        select(Job.id)
        .join(Generation, Generation.id == Job.generation_id)
        .join(Photo, Photo.id == Job.photo_id)
        .where(
            Generation.state == GenerationState.ACTIVE,
            Job.state == JobState.FAILED,
            Job.kind == JobKind.REINDEX,
            or_(Photo.job_id.is_(None), Photo.job_id < Job.id),
        )
        .limit(REINDEX_JOBS_PER_TRANSACTION)
    )
    while True:
        with catalog.write() as session:
            job_ids = session.scalars(failed).all()
            if job_ids:
                session.execute(
                    update(Photo)
                    .where(Photo.id == Job.photo_id, Job.id.in_(job_ids))
                    .values(job_id=Job.id)
                    .execution_options(synchronize_session=False)
                )
        if len(job_ids) < REINDEX_JOBS_PER_TRANSACTION:
            return


def delete_done_reindex_jobs(catalog: Catalog) -> None:
    """Delete the successful and cancelled reindex jobs of activated generations.

    Works for up to SLICE_SECONDS: a model change has as many jobs as its map has photos.
    """
    done = (
        select(Job.id)
        .join(Generation, Generation.id == Job.generation_id)
        .where(
            Generation.state.in_((GenerationState.ACTIVE, GenerationState.RETIRED)),
            Job.state.in_((JobState.SUCCEEDED, JobState.CANCELLED)),
            Job.kind == JobKind.REINDEX,
        )
        .limit(DELETED_JOBS_PER_TRANSACTION)
    )
    deadline = time.monotonic() + SLICE_SECONDS
    while time.monotonic() < deadline:
        with catalog.write() as session:
            deleted = affected_rows(session.execute(delete(Job).where(Job.id.in_(done))))
        if deleted < DELETED_JOBS_PER_TRANSACTION:
            return
