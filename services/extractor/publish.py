"""Publication of a described batch: a chunk in the object store, then one catalog transaction.

A crash between the two leaves an orphaned object, which the steward deletes. A job whose lease was
taken over, or that was cancelled, is skipped: its row stays in the chunk as a dead row.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any
from uuid import UUID

import numpy as np
import torch
from sqlalchemy import and_, insert, select
from sqlalchemy.orm import Session

from services.extractor.handlers import ExtractorContext, JobBatch
from services.extractor.local_features import BatchFeatures
from shared.catalog.chunks import Chunk, Descriptor
from shared.catalog.generations import Generation, GenerationState, lock_generation
from shared.catalog.maps import increment_map_version, lock_map
from shared.catalog.photos import Photo
from shared.errors import PlacewiseError
from shared.ids import new_id
from shared.jobs import Job, JobKind
from shared.jobs.leases import lock_leased_jobs
from shared.jobs.runner import distinct_request_ids
from shared.jobs.transitions import cancel_job, fail_job, requeue_job, succeed_job
from shared.storage.chunks import Rows, WrittenChunk, encode_rows, write_chunk
from shared.storage.feature_files import encode_feature_file
from shared.storage.keys import query_features_key, query_vector_key

log = logging.getLogger(__name__)

Failures = Sequence[tuple[Job, PlacewiseError]]
"""Jobs whose photo can't be described, each with the reason."""


def photo_id_of(job: Job) -> UUID:
    """Return the photo of an index or reindex job."""
    assert job.photo_id is not None, "index and reindex jobs name a photo"
    return job.photo_id


def publish(
    context: ExtractorContext,
    batch: JobBatch,
    generation: Generation,
    ready: Sequence[Job],
    failed: Failures,
    rows: Rows,
    features: BatchFeatures | None,
) -> None:
    """Store and commit the (n, dimension) rows of the jobs in `ready`; fail those in `failed`."""
    chunk_id, written = new_id(), None
    if batch.kind == JobKind.DESCRIBE:
        for job, row in zip(ready, rows, strict=True):
            context.store.put(query_vector_key(job.id), encode_rows(row[np.newaxis]))
            if features and job.id in features.encoded:
                key = query_features_key(job.id)
                context.store.put(key, encode_feature_file(features.rows([job]), key))
    elif ready:
        written = write_chunk(
            context.store,
            generation_id=generation.id,
            chunk_id=chunk_id,
            # NumPy rounds to the same float16 in twenty times the time.
            rows=torch.from_numpy(rows).to(getattr(torch, generation.row_type)).numpy(),
            photo_ids=[photo_id_of(job) for job in ready],
            spec=generation.spec,
            features=features.rows(ready) if features else None,
        )

    def commit(session: Session) -> Counter[str]:
        if batch.kind == JobKind.DESCRIBE:
            return _commit_queries(session, batch, generation.id, ready, failed)
        return _commit_photos(session, batch, generation.id, ready, failed, chunk_id, written)

    batch.outcomes.update(context.catalog.run(commit))
    batch.reasons.update(error.code for _, error in failed)
    log.info(
        "published: %d succeeded, %d failed",
        batch.outcomes["succeeded"],
        batch.outcomes["failed"],
        extra={
            "kind": str(batch.kind),
            "map_id": str(batch.jobs[0].map_id),
            "generation_id": str(generation.id),
            "job_ids": [str(job.id) for job in batch.jobs],
            "request_ids": distinct_request_ids(batch.jobs),
            "chunk": written.object_key if written else None,
        },
    )


def _commit_photos(
    session: Session,
    batch: JobBatch,
    generation_id: UUID,
    ready: Sequence[Job],
    failed: Failures,
    chunk_id: UUID,
    written: WrittenChunk | None,
) -> Counter[str]:
    """Register the chunk and end the jobs; return the number of jobs by outcome."""
    lock_map(session, batch.jobs[0].map_id)
    generation = lock_generation(session, generation_id)
    owned = {job.id: job for job in lock_leased_jobs(session, batch.token, batch.jobs)}
    outcomes = Counter(lost=len(batch.jobs) - len(owned))
    is_built = batch.kind != JobKind.INDEX and generation.state == GenerationState.BUILDING
    if generation.state != GenerationState.ACTIVE and not is_built:
        # A model change was activated or abandoned while the batch was computed.
        for job in owned.values():
            cancel_job(job) if batch.kind == JobKind.REINDEX else requeue_job(job)
        return outcomes
    # A batch that lost its lease after its commit has described photos already.
    of_photo = and_(Descriptor.generation_id == generation_id, Descriptor.photo_id == Photo.id)
    live_photos = session.execute(
        select(Photo.id, Descriptor.photo_id.is_not(None))
        .outerjoin(Descriptor, of_photo)
        .where(Photo.id.in_([job.photo_id for job in owned.values()]), Photo.deleted_at.is_(None))
    )
    is_described: dict[UUID | None, bool] = dict(live_photos.all())
    for job_id, job in list(owned.items()):
        if job.photo_id not in is_described:
            cancel_job(job)
            del owned[job_id]
    outcomes["failed"] = _fail_jobs(owned, failed)
    new_rows: list[dict[str, Any]] = []
    for row, claimed in enumerate(ready):
        if (leased := owned.get(claimed.id)) is None:
            continue  # a dead row
        if not is_described[leased.photo_id]:
            new_rows.append({"photo_id": leased.photo_id, "row": row})
        file_id = str(leased.photo_id)
        succeed_job(leased, {"file_id": file_id, "generation_id": str(generation_id)})
        outcomes["succeeded"] += 1
    if new_rows and written is not None:
        place = {"generation_id": generation_id, "chunk_id": chunk_id}
        session.add(Chunk(id=chunk_id, generation_id=generation_id, **asdict(written)))
        session.flush()
        session.execute(insert(Descriptor), [place | columns for columns in new_rows])
        increment_map_version(session, generation.map_id)
    return outcomes


def _commit_queries(
    session: Session,
    batch: JobBatch,
    generation_id: UUID,
    ready: Sequence[Job],
    failed: Failures,
) -> Counter[str]:
    owned = {job.id: job for job in lock_leased_jobs(session, batch.token, batch.jobs)}
    outcomes = Counter(lost=len(batch.jobs) - len(owned), failed=_fail_jobs(owned, failed))
    for claimed in ready:
        if claimed.id in owned:
            reference = {
                "generation_id": str(generation_id),
                "object_key": query_vector_key(claimed.id),
                "row": 0,
            }
            succeed_job(owned[claimed.id], reference)
            outcomes["succeeded"] += 1
    return outcomes


def _fail_jobs(owned: dict[UUID, Job], failed: Failures) -> int:
    """Fail those of the jobs that are still owned; return their number."""
    errors = [(owned[claimed.id], error) for claimed, error in failed if claimed.id in owned]
    for job, error in errors:
        fail_job(job, error.as_problem())
    return len(errors)
