"""Model changes: a new vocabulary or PCA for a map, and the generation made with it.

```
POST /vocabularies ─> FIT     ─ sample ─ cluster ─┐
     .../import    ─> IMPORT  ─ check ────────────┼─> begin_generation ─> waits for descriptors
POST /generations  ─> SWITCH  ────────────────────┤        │
                   ─> PCA     ─ gather ─ reduce ──┘        │
                                                           v
       every live photo is in it, or its failure is recorded: the steward switches and succeeds
```
At most one is under way in a map.
"""

from __future__ import annotations

from typing import Any
from uuid import UUID

from sqlalchemy import select
from sqlalchemy.orm import Session

from shared.catalog.base import db_now
from shared.catalog.generations import (
    Generation,
    GenerationState,
    active_generation,
    lock_generation,
)
from shared.catalog.jobs import (
    MODEL_CHANGE_JOBS,
    UNFINISHED_STATES,
    Job,
    JobKind,
    Priority,
    WaitingFor,
)
from shared.catalog.maps import increment_map_version, lock_map
from shared.errors import Conflict
from shared.ids import new_id
from shared.jobs.transitions import cancel_job, cancel_jobs, release_job, wake_waiting_jobs


def start_model_change(
    session: Session, map_id: UUID, kind: JobKind, params: dict[str, Any]
) -> Job:
    """Queue a model change; 409 (`model_change_running`) names the one under way."""
    lock_map(session, map_id)
    running = get_unfinished_model_change(session, map_id)
    if running is not None:
        raise Conflict(
            "model_change_running",
            f"The map is already changing its model (job {running.id}, {running.kind}). "
            f"Wait for it, or cancel it: POST /api/v1/jobs/{running.id}/cancel.",
            job_id=str(running.id),
        )
    job = Job(
        id=new_id(),
        map_id=map_id,
        kind=kind,
        priority=Priority.MODEL_CHANGE,
        params=params,
    )
    session.add(job)
    session.flush()
    return job


def get_unfinished_model_change(session: Session, map_id: UUID) -> Job | None:
    """The model change that is under way in the map, if any."""
    return session.scalar(
        select(Job).where(
            Job.map_id == map_id, Job.kind.in_(MODEL_CHANGE_JOBS), Job.state.in_(UNFINISHED_STATES)
        )
    )


def create_generation(session: Session, job: Job, **columns: Any) -> Generation:
    """The generation that the model change `job` leads to; the job now waits for descriptors.

    In a map without an active generation it answers at once, and photos that waited for a
    vocabulary are described into it. Otherwise it is built beside the active one.
    """
    map_ = lock_map(session, job.map_id)
    first = active_generation(session, job.map_id) is None
    generation = Generation(
        id=new_id(),
        map_id=job.map_id,
        state=GenerationState.ACTIVE if first else GenerationState.BUILDING,
        activated_at=db_now() if first else None,
        **columns,
    )
    session.add(generation)
    session.flush()
    if first:
        map_.extractor = generation.extractor
        wake_vocabulary_waiters(session, job.map_id)
        increment_map_version(session, job.map_id)
    job.generation_id = generation.id
    job.stage = "describe"
    release_job(job, waiting_for=WaitingFor.DESCRIPTORS)
    return generation


def wake_vocabulary_waiters(session: Session, map_id: UUID) -> None:
    """The map has a vocabulary: photos and queries that waited for one may go on."""
    wake_waiting_jobs(session, (Job.map_id == map_id) & (Job.waiting_for == WaitingFor.VOCABULARY))


def cancel_model_change(session: Session, job: Job) -> None:
    """Cancel the job, and give up the generation that it was building."""
    cancel_job(job)
    abandon_generation(session, job)


def abandon_generation(session: Session, job: Job) -> None:
    """Give up the generation that an ended model change was building, with its queued photos.

    Any other job, one of those photos' too, ends without touching its generation.
    """
    if job.kind not in MODEL_CHANGE_JOBS or job.generation_id is None:
        return
    generation = lock_generation(session, job.generation_id)
    if generation.state != GenerationState.BUILDING:
        return
    generation.state = GenerationState.ABANDONED
    generation.ended_at = db_now()
    cancel_jobs(session, (Job.generation_id == generation.id) & (Job.kind == JobKind.REINDEX))
