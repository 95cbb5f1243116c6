"""Model changes: jobs that give a map a new vocabulary, PCA or extractor, and a new generation.

```
POST /vocabularies ─> FIT     ─ sample ─ cluster ─┐
     .../import    ─> IMPORT  ─ check ────────────┼─> create_generation ─> waits for descriptors
POST /generations  ─> SWITCH  ────────────────────┤        │
                   ─> PCA     ─ gather ─ reduce ──┘        │
                                                           v
       each live photo has a descriptor or a recorded failure: the steward activates the generation
```
A map has at most one unfinished model change.
"""

from __future__ import annotations

from typing import Any
from uuid import UUID

from sqlalchemy import select
from sqlalchemy.orm import Session

from shared.catalog.database.base import db_now, insert_row
from shared.catalog.generations import (
    Generation,
    GenerationState,
    active_generation,
    lock_generation,
)
from shared.catalog.jobs import MODEL_CHANGE_JOBS, UNFINISHED_STATES, Job, JobKind, WaitingFor
from shared.catalog.maps import Matching, increment_map_version, lock_map
from shared.catalog.photos import PhotoRole, count_live_photos
from shared.errors import Conflict
from shared.jobs.transitions import cancel_job, cancel_jobs, requeue_job


def start_model_change(
    session: Session, map_id: UUID, kind: JobKind, params: dict[str, Any]
) -> Job:
    """Queue a model change for the map.

    The next automatic vocabulary fit starts when the map has twice the photos that it has at this
    one, however it ends (`next_fit_photos`).

    Raises:
        Conflict: `model_change_running`, naming the unfinished one.
    """
    map_ = lock_map(session, map_id)
    running = get_unfinished_model_change(session, map_id)
    if running is not None:
        raise Conflict(
            "model_change_running",
            f"The map already has a running model change (job {running.id}, {running.kind}). "
            f"Wait for it, or cancel it: POST /api/v1/jobs/{running.id}/cancel?map={map_.name}.",
            job_id=str(running.id),
        )
    job = Job(map_id=map_id, kind=kind, params=params)
    session.add(job)
    if kind == JobKind.FIT:
        map_.fitted_photos = count_live_photos(session, map_id, PhotoRole.DATABASE)
    session.flush()
    return job


def start_reindex(session: Session, generation: Generation) -> Job:
    """Queue a model change with the vocabulary and whitening of the map's active generation.

    Rows whose spec is still the same are copied. Raises as `start_model_change` does.
    """
    ids = {"vocabulary_id": generation.vocabulary_id, "whitening_id": generation.whitening_id}
    params = {name: None if id_ is None else str(id_) for name, id_ in ids.items()}
    return start_model_change(session, generation.map_id, JobKind.SWITCH, params)


def get_unfinished_model_change(session: Session, map_id: UUID) -> Job | None:
    """Return the unfinished model change of the map, if any."""
    return session.scalar(
        select(Job).where(
            Job.map_id == map_id, Job.kind.in_(MODEL_CHANGE_JOBS), Job.state.in_(UNFINISHED_STATES)
        )
    )


def create_generation(session: Session, job: Job, **columns: Any) -> Generation:
    """Create the generation of the model change `job`, which then waits for its descriptors.

    In a map without an active generation, the new one is active at once. Otherwise it is built
    while the active one serves queries.
    """
    map_ = lock_map(session, job.map_id)
    active = active_generation(session, job.map_id)
    first = active is None
    is_decided = active and active.uses_matches is False and map_.matching == Matching.AUTO
    generation = Generation(
        map_id=job.map_id,
        state=GenerationState.ACTIVE if first else GenerationState.BUILDING,
        activated_at=db_now() if first else None,
        row_type=map_.row_type,
        # Without features, an evaluation could not decide it again.
        uses_matches=False if is_decided else None,
        **columns,
    )
    insert_row(session, generation)
    if first:
        map_.extractor = generation.extractor
        increment_map_version(session, job.map_id)
    job.generation_id = generation.id
    job.stage = "describe"
    requeue_job(job, waiting_for=WaitingFor.DESCRIPTORS)
    return generation


def cancel_model_change(session: Session, job: Job) -> None:
    """Cancel the job and abandon the generation that it was building."""
    cancel_job(job)
    abandon_generation(session, job)


def abandon_generation(session: Session, job: Job) -> None:
    """Abandon the generation that an ended model change was building, and cancel its photo jobs.

    The steward cancels those that remain. An extractor that claims one before can't publish it.
    Does nothing for any other job: the end of one photo's job does not affect its generation.
    """
    if job.kind not in MODEL_CHANGE_JOBS or job.generation_id is None:
        return
    generation = lock_generation(session, job.generation_id)
    if generation.state != GenerationState.BUILDING:
        return
    generation.state = GenerationState.ABANDONED
    generation.ended_at = db_now()
    cancel_jobs(session, (Job.generation_id == generation.id) & (Job.kind == JobKind.REINDEX))
