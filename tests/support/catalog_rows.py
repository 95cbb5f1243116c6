"""Rows of the catalog that tests begin with: maps, photos, jobs, generations, chunks.

Every function adds to the session it is given and flushes; the caller's `write()` commits.
"""

from __future__ import annotations

import hashlib
import itertools
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Any
from uuid import UUID

import numpy as np
from sqlalchemy import select, text, update
from sqlalchemy.orm import Session

from services.steward.tasks.compaction import merge_chunks
from shared.catalog.chunks import Chunk, Descriptor, list_live_chunks
from shared.catalog.database.base import db_now, db_now_plus
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation, GenerationState, lock_generation
from shared.catalog.jobs import MODEL_CHANGE_JOBS, UNFINISHED_STATES
from shared.catalog.maps import Map, increment_map_version, lock_map
from shared.catalog.models import get_or_create_model
from shared.catalog.photos import Photo, get_photo, mark_photo_deleted
from shared.catalog.reconstructions import ReconstructedComponent, Reconstruction
from shared.ids import new_id
from shared.jobs import Job, JobKind, JobState, Priority
from shared.jobs.claim import claim_jobs
from shared.jobs.transitions import cancel_job
from shared.storage import ObjectStore
from shared.storage.chunks import Rows, StoredRows, read_chunk, write_chunk
from shared.storage.feature_files import FeatureRows
from shared.storage.keys import component_key, new_original_key, query_key
from shared.storage.read_retries import ReadRetries

NUMBERS = itertools.count(1)
PRIORITIES = {
    JobKind.INDEX: Priority.UPLOAD,
    JobKind.REINDEX: Priority.REINDEX,
    JobKind.DESCRIBE: Priority.QUERY,
    JobKind.EVALUATE: Priority.EVALUATION,
    JobKind.SYNC_LIBRARY: Priority.BATCH,
    **dict.fromkeys(
        (*MODEL_CHANGE_JOBS, JobKind.ADD_MODEL, JobKind.RECONSTRUCT), Priority.MODEL_CHANGE
    ),
}


def add_map(session: Session, name: str = "default", extractor: str = "test-tiny-avg") -> Map:
    made = Map(id=new_id(), name=name, extractor=extractor)
    session.add(made)
    session.flush()
    return made


def made_up_photo(map_id: UUID, **columns: Any) -> dict[str, Any]:
    """The columns of a photo without bytes in any store; `columns` replace what is made up."""
    number = next(NUMBERS)
    return {
        "id": new_id(),
        "map_id": map_id,
        "sha256": hashlib.sha256(str(number).encode()).hexdigest(),
        "object_key": new_original_key(),
        "filename": f"photo-{number}.jpg",
        "media_type": "image/jpeg",
        "size_bytes": 1000 + number,
        "width": 64,
        "height": 48,
        **columns,
    }


def add_photo(session: Session, map_id: UUID, **columns: Any) -> Photo:
    """A live photo without bytes in any store; `columns` replace what is made up."""
    photo = Photo(**made_up_photo(map_id, **columns))
    session.add(photo)
    session.flush()
    return photo


def add_job(session: Session, map_id: UUID, kind: JobKind = JobKind.INDEX, **columns: Any) -> Job:
    """A queued job with the priority of its kind."""
    job = Job(
        **{"id": new_id(), "map_id": map_id, "kind": kind, "priority": PRIORITIES[kind], **columns}
    )
    session.add(job)
    session.flush()
    return job


def upload(catalog: Catalog, store: ObjectStore, map_id: UUID, data: bytes) -> tuple[UUID, UUID]:
    """What the gateway leaves behind of an upload: bytes, photo and job; the ids of the two."""
    key = new_original_key()
    store.put(key, data)
    with catalog.write() as session:
        photo = add_photo(
            session,
            map_id,
            object_key=key,
            sha256=hashlib.sha256(data).hexdigest(),
            size_bytes=len(data),
        )
        job = add_job(session, map_id, photo_id=photo.id)
        photo.job_id = job.id
        return photo.id, job.id


def add_reconstruction(
    session: Session, store: ObjectStore, generation: Generation, **columns: Any
) -> Reconstruction:
    """A finished reconstruction of one component, with an object of arbitrary bytes."""
    made_id, data = new_id(), b"a component"
    key = component_key(made_id, 0)
    store.put(key, data)
    component = ReconstructedComponent(
        number=0,
        object_key=key,
        sha256={key: hashlib.sha256(data).hexdigest()},
        photos=2,
        points=3,
        mean_reprojection_error_pixels=0.5,
        not_aligned="No photo has coordinates.",
    )
    reconstruction = Reconstruction(
        **{
            "id": made_id,
            "map_id": generation.map_id,
            "job_id": new_id(),
            "generation_id": generation.id,
            "map_version": 1,
            "features_model": "xfeat@1",
            "components": [component.model_dump(mode="json")],
            "finished_at": datetime.now(UTC),
            **columns,
        }
    )
    session.add(reconstruction)
    session.flush()
    return reconstruction


def ask(catalog: Catalog, store: ObjectStore, map_id: UUID, data: bytes) -> UUID:
    """What the gateway leaves behind of a query with a new photo; the job's id."""
    job_id = new_id()
    store.put(query_key(job_id), data)
    with catalog.write() as session:
        return add_job(session, map_id, JobKind.DESCRIBE, id=job_id).id


def delete(catalog: Catalog, map_id: UUID, photo_id: UUID) -> None:
    """As `DELETE /uploads/{file_id}` does it."""
    with catalog.write() as session:
        lock_map(session, map_id)
        photo = get_photo(session, map_id, photo_id)
        mark_photo_deleted(session, photo, increment_map_version(session, map_id))
        for job in session.scalars(
            select(Job).where(Job.photo_id == photo_id, Job.state.in_(UNFINISHED_STATES))
        ):
            cancel_job(job)


def add_generation(
    session: Session,
    map_id: UUID,
    state: GenerationState = GenerationState.ACTIVE,
    **columns: Any,
) -> Generation:
    """A generation of rows with 4 numbers."""
    model = get_or_create_model(session, "test-rows", "0" * 64, "MIT", {})
    generation = Generation(
        **{
            "id": new_id(),
            "map_id": map_id,
            "state": state,
            "extractor": "test-rows",
            "spec": {"clusters": None},
            "spec_fingerprint": "0" * 64,
            "dimension": 4,
            "model_id": model.id,
            "activated_at": db_now() if state == GenerationState.ACTIVE else None,
            **columns,
        }
    )
    session.add(generation)
    session.flush()
    return generation


def add_chunk(
    catalog: Catalog,
    store: ObjectStore,
    generation_id: UUID,
    photo_ids: list[UUID],
    rows: StoredRows | None = None,
    dead: int = 0,
    features: FeatureRows | None = None,
) -> UUID:
    """Publish a chunk with a row for each photo, `row_of` it by default, and return its id.

    Args:
        dead: Number of rows at the beginning that no photo refers to, as after a lost lease.
    """
    chunk_id = new_id()
    written = write_chunk(
        store,
        generation_id=generation_id,
        chunk_id=chunk_id,
        rows=np.stack([row_of(one) for one in photo_ids]) if rows is None else rows,
        photo_ids=photo_ids,
        spec={},
        features=features,
    )
    with catalog.write() as session:
        generation = lock_generation(session, generation_id)
        session.add(Chunk(id=chunk_id, generation_id=generation_id, **asdict(written)))
        session.flush()
        session.add_all(
            Descriptor(generation_id=generation_id, photo_id=photo_id, chunk_id=chunk_id, row=row)
            for row, photo_id in enumerate(photo_ids)
            if row >= dead
        )
        increment_map_version(session, generation.map_id)
    return chunk_id


def merge_all(catalog: Catalog, store: ObjectStore, generation_id: UUID) -> bool:
    """Merge all chunks of the generation into one; False if that can't be done."""
    with catalog.read() as session:
        chunk_ids = [chunk.id for chunk in list_live_chunks(session, generation_id)]
    return merge_chunks(catalog, store, generation_id, chunk_ids, ReadRetries())


def row_of(photo_id: UUID) -> Rows:
    """The made-up descriptor of a photo: 4 numbers that no other photo has."""
    row = np.random.default_rng(photo_id.int).standard_normal(4).astype(np.float32)
    unit: Rows = row / np.linalg.norm(row)
    return unit


def stored_rows(catalog: Catalog, store: ObjectStore, generation_id: UUID) -> dict[UUID, Rows]:
    """The descriptor that the generation holds of each photo, read from its chunk."""
    found: dict[UUID, Any] = {}  # as stored: float16 rows, too
    with catalog.read() as session:
        pairs = session.execute(
            select(Descriptor, Chunk)
            .join(Chunk, Chunk.id == Descriptor.chunk_id)
            .where(Descriptor.generation_id == generation_id)
        ).all()
    for descriptor, chunk in pairs:
        rows = read_chunk(store, chunk.object_key, chunk.sha256)
        found[descriptor.photo_id] = rows[descriptor.row]
    return found


def read_job(catalog: Catalog, job_id: UUID) -> Job:
    """The job as it is now."""
    with catalog.read() as session:
        return session.get_one(Job, job_id)


def states(catalog: Catalog, job_ids: list[UUID]) -> list[JobState]:
    """The jobs' states, in the order of the ids."""
    return [JobState(read_job(catalog, job_id).state) for job_id in job_ids]


def set_columns(catalog: Catalog, job_id: UUID, **columns: Any) -> None:
    """Change a job behind everyone's back."""
    with catalog.write() as session:
        session.execute(
            update(Job)
            .where(Job.id == job_id)
            .values(**columns)
            .execution_options(synchronize_session=False)
        )


def expire_lease(catalog: Catalog, *job_ids: UUID) -> None:
    """Let the lease of the jobs expire, as if their worker were dead."""
    for job_id in job_ids:
        set_columns(catalog, job_id, lease_until=db_now_plus(-1.0))


def is_lock_awaited(catalog: Catalog) -> bool:
    """Whether a transaction waits for a lock of another one; PostgreSQL only."""
    with catalog.read() as session:
        return bool(session.scalar(text("SELECT count(*) FROM pg_locks WHERE NOT granted")))


def end_pauses(catalog: Catalog) -> None:
    """The time of every pausing job has come."""
    with catalog.write() as session:
        session.execute(
            update(Job).values(run_after=None).execution_options(synchronize_session=False)
        )


def take(
    catalog: Catalog,
    limit: int = 10,
    worker: str = "worker",
    lease_seconds: float = 60,
    least_priority: int | None = None,
) -> list[Job]:
    """Claim in a transaction of its own."""
    with catalog.write() as session:
        return claim_jobs(
            session,
            worker=worker,
            limit=limit,
            lease_seconds=lease_seconds,
            min_priority=least_priority,
        )


def problem_of(job: Job) -> dict[str, Any]:
    assert job.error is not None
    return job.error


def result_of(job: Job) -> dict[str, Any]:
    """The result of a job that has succeeded."""
    assert job.state == JobState.SUCCEEDED, job.error
    assert job.result is not None
    return job.result


def failure_code(job: Job) -> str:
    assert job.state == JobState.FAILED
    return str(problem_of(job)["code"])
