"""Evaluating maps that have changed, so that their answers can say "not in this map"."""

from __future__ import annotations

from typing import Any
from uuid import UUID

from sqlalchemy import exists, select
from sqlalchemy.orm import Session

from shared.catalog.evaluations import last_evaluation
from shared.catalog.figures import figures_of
from shared.catalog.generations import Generation, active_generation
from shared.catalog.maps import list_maps, lock_map
from shared.catalog.session import Catalog
from shared.ids import new_id
from shared.jobs import Job, JobKind, JobState, Priority
from shared.jobs.table import QUERY_JOBS, UNFINISHED

SAMPLE_PHOTOS = 300  # enough for a threshold that one in twenty exceeds
CHANGED_SHARE = 0.2  # of the photos: more, and the last evaluation is out of date


def evaluate_changed_maps(catalog: Catalog, least_photos: int) -> None:
    """Queue an evaluation for each map that is at rest and has changed since its last one."""
    if not least_photos:
        return
    with catalog.read() as session:
        due = [map_.id for map_ in list_maps(session) if _due(session, map_.id, least_photos)]
    for map_id in due:
        with catalog.write() as session:
            lock_map(session, map_id)
            params = _due(session, map_id, least_photos)
            if params is None:
                continue  # another steward was first
            session.add(
                Job(
                    id=new_id(),
                    map_id=map_id,
                    kind=JobKind.EVALUATE,
                    priority=Priority.EVALUATION,
                    params=params,
                )
            )


def _due(session: Session, map_id: UUID, least_photos: int) -> dict[str, Any] | None:
    """The evaluation that the map should have now, if any: the parameters of its job."""
    generation = active_generation(session, map_id)
    if generation is None or _is_busy(session, map_id):
        return None
    figures, _ = figures_of(session, map_id)
    if figures.located < least_photos:
        return None
    searchable, queries = figures.searchable, figures.located_queries
    seen = _seen(session, generation)
    if seen is not None and not (_differs(searchable, seen[0]) or _differs(queries, seen[1])):
        return None
    return {
        "sample": SAMPLE_PHOTOS,
        "seed": 0,
        "automatic": True,
        "generation_id": str(generation.id),
        "searchable": searchable,
        "labelled_queries": queries,
    }


def _is_busy(session: Session, map_id: UUID) -> bool:
    """Photos are being described, or an evaluation is under way: what is found still changes."""
    unfinished = exists().where(
        Job.map_id == map_id, Job.state.in_(UNFINISHED), Job.kind.not_in(QUERY_JOBS)
    )
    return bool(session.scalar(select(unfinished)))


def _seen(session: Session, generation: Generation) -> tuple[int, int] | None:
    """How many photos and labelled queries the last evaluation saw, also one that was queued here
    and came to nothing: its reason is in its job, and it is not tried for ever."""
    job = session.scalar(
        select(Job)
        .where(Job.map_id == generation.map_id, Job.kind == JobKind.EVALUATE)
        .order_by(Job.id.desc())
        .limit(1)
    )
    if (
        job is not None
        and job.state in (JobState.FAILED, JobState.CANCELLED)
        and job.params.get("generation_id") == str(generation.id)
    ):
        return job.params["searchable"], job.params["labelled_queries"]
    last = last_evaluation(session, generation.id)
    return None if last is None else (last.searchable, last.labelled_queries)


def _differs(now: int, then: int) -> bool:
    return abs(now - then) > CHANGED_SHARE * then
