"""Publication of a described batch: a chunk in the object store, then one catalog transaction.

A crash between the two leaves an orphaned object, which the steward deletes. A job whose lease was
taken over, or that was cancelled, is skipped: its row stays in the chunk as a dead row.
"""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from sqlalchemy import insert, select
from sqlalchemy.orm import Session

from services.extractor.prepare import DescribeBatch, photo_id_of
from shared.catalog.chunks import Chunk, Descriptor, allocate_slot
from shared.catalog.database.session import Catalog
from shared.catalog.generations import GenerationState, lock_generation
from shared.catalog.maps import increment_map_version, lock_map
from shared.catalog.photos import get_live_photos
from shared.ids import new_id
from shared.jobs import JobKind
from shared.jobs.leases import lock_leased_jobs
from shared.jobs.runner import distinct_request_ids
from shared.jobs.transitions import cancel_job, fail_job, requeue_job, succeed_job
from shared.storage import ObjectStore
from shared.storage.chunks import Rows, encode_rows, write_chunk
from shared.storage.keys import query_vector_key

log = logging.getLogger(__name__)


@dataclass(slots=True)
class PublishResult:
    """Number of jobs by outcome."""

    succeeded: int = 0
    failed: int = 0
    lost: int = 0
    """Jobs that another worker took over, or that were cancelled, meanwhile."""


def publish(
    catalog: Catalog, store: ObjectStore, batch: DescribeBatch, rows: Rows, slot_rows: int
) -> PublishResult:
    """Store and commit a described batch; `rows` are those of `batch.ready`."""
    started = time.perf_counter()
    rows = batch.reject_non_finite(rows)
    if batch.kind == JobKind.DESCRIBE:
        outcome, chunk = _publish_queries(catalog, store, batch, rows), None
    else:
        outcome, chunk = _publish_photos(catalog, store, batch, rows, slot_rows)
    batch.seconds["publish"] = time.perf_counter() - started
    log.info(
        "published: %d succeeded, %d failed",
        outcome.succeeded,
        outcome.failed,
        extra={
            "kind": str(batch.kind),
            "map_id": str(batch.jobs[0].map_id),
            "generation_id": str(batch.target.generation.id),
            "job_ids": [str(job.id) for job in batch.jobs],
            "request_ids": distinct_request_ids(batch.jobs),
            "chunk": chunk,
        },
    )
    return outcome


def _publish_photos(
    catalog: Catalog, store: ObjectStore, batch: DescribeBatch, rows: Rows, slot_rows: int
) -> tuple[PublishResult, str | None]:
    """Return the outcome, and the key of the chunk."""
    generation_id = batch.target.generation.id
    chunk_id = new_id()
    written = None
    if len(rows):
        written = write_chunk(
            store,
            generation_id=generation_id,
            chunk_id=chunk_id,
            rows=rows.astype(batch.target.generation.row_type, copy=False),
            photo_ids=[photo_id_of(job) for job in batch.ready],
            spec=batch.target.generation.spec,
        )

    def commit(session: Session) -> PublishResult:
        outcome = PublishResult()
        lock_map(session, batch.jobs[0].map_id)
        generation = lock_generation(session, generation_id)
        owned = {job.id: job for job in lock_leased_jobs(session, batch.token, batch.jobs)}
        outcome.lost = len(batch.jobs) - len(owned)
        if generation.state not in _accepted_generation_states(batch.kind):
            # A model change was activated or abandoned while the batch was computed.
            for job in owned.values():
                cancel_job(job) if batch.kind == JobKind.REINDEX else requeue_job(job)
            return outcome
        live = get_live_photos(session, [photo_id_of(job) for job in owned.values()])
        # A batch that lost its lease after its commit has described photos already.
        described = set(
            session.scalars(
                select(Descriptor.photo_id).where(
                    Descriptor.generation_id == generation_id, Descriptor.photo_id.in_(live)
                )
            )
        )
        for job in owned.values():
            if job.photo_id not in live:
                cancel_job(job)
        for claimed, error in batch.failed:
            leased_job = owned.get(claimed.id)
            if leased_job is not None and leased_job.photo_id in live:
                fail_job(leased_job, error.as_problem())
                outcome.failed += 1
        new_rows: list[dict[str, Any]] = []
        for row, claimed in enumerate(batch.ready):
            leased_job = owned.get(claimed.id)
            if leased_job is None or leased_job.photo_id not in live:
                continue  # a dead row
            if leased_job.photo_id not in described:
                new_rows.append({"photo_id": leased_job.photo_id, "row": row})
            file_id = str(leased_job.photo_id)
            succeed_job(leased_job, {"file_id": file_id, "generation_id": str(generation_id)})
            outcome.succeeded += 1
        if new_rows and written is not None:
            session.add(
                Chunk(
                    id=chunk_id,
                    generation_id=generation_id,
                    slot=allocate_slot(generation, written.rows, slot_rows),
                    object_key=written.object_key,
                    rows=written.rows,
                    size_bytes=written.size_bytes,
                    sha256=written.sha256,
                )
            )
            session.flush()
            place = {"generation_id": generation_id, "chunk_id": chunk_id}
            session.execute(insert(Descriptor), [place | columns for columns in new_rows])
            increment_map_version(session, generation.map_id)
        return outcome

    return catalog.run(commit), written.object_key if written else None


def _publish_queries(
    catalog: Catalog, store: ObjectStore, batch: DescribeBatch, rows: Rows
) -> PublishResult:
    for job, row in zip(batch.ready, rows, strict=True):
        store.put(query_vector_key(job.id), encode_rows(row[np.newaxis]))

    def commit(session: Session) -> PublishResult:
        outcome = PublishResult()
        owned = {job.id: job for job in lock_leased_jobs(session, batch.token, batch.jobs)}
        outcome.lost = len(batch.jobs) - len(owned)
        for claimed, error in batch.failed:
            if claimed.id in owned:
                fail_job(owned[claimed.id], error.as_problem())
                outcome.failed += 1
        for claimed in batch.ready:
            if claimed.id in owned:
                reference = {
                    "generation_id": str(batch.target.generation.id),
                    "object_key": query_vector_key(claimed.id),
                    "row": 0,
                }
                succeed_job(owned[claimed.id], reference)
                outcome.succeeded += 1
        return outcome

    return catalog.run(commit)


def _accepted_generation_states(kind: JobKind) -> tuple[GenerationState, ...]:
    if kind == JobKind.INDEX:
        return (GenerationState.ACTIVE,)
    return (GenerationState.BUILDING, GenerationState.ACTIVE)
