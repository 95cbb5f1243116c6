"""Evaluating maps that have changed, so that their answers can say "not in this map"."""

from __future__ import annotations

from uuid import UUID

from sqlalchemy import exists, select
from sqlalchemy.orm import Session

from shared.catalog.chunks import count_searchable
from shared.catalog.evaluations import last_evaluation
from shared.catalog.generations import active_generation
from shared.catalog.maps import list_maps, lock_map
from shared.catalog.photos import PhotoRole, count_live, count_located
from shared.catalog.session import Catalog
from shared.ids import new_id
from shared.jobs import Job, JobKind, JobState, Priority
from shared.jobs.table import UNFINISHED

SAMPLE_PHOTOS = 300  # enough for a threshold that one in twenty exceeds
CHANGED_SHARE = 0.2  # of the photos: more, and the last evaluation is out of date


def evaluate_changed_maps(catalog: Catalog, least_photos: int) -> None:
    """Queue an evaluation for each map that is at rest and has changed since its last one."""
    if not least_photos:
        return
    with catalog.read() as session:
        due = [map_.id for map_ in list_maps(session) if _is_due(session, map_.id, least_photos)]
    for map_id in due:
        params = {"sample": SAMPLE_PHOTOS, "seed": 0, "automatic": True}
        with catalog.write() as session:
            lock_map(session, map_id)
            if not _is_due(session, map_id, least_photos):
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


def _is_due(session: Session, map_id: UUID, least_photos: int) -> bool:
    generation = active_generation(session, map_id)
    if generation is None or _is_busy(session, map_id):
        return False
    if count_located(session, map_id) < least_photos:
        return False
    last = last_evaluation(session, generation.id)
    if last is None:
        return not _has_failed(session, map_id)
    return _differs(count_searchable(session, generation.id), last.searchable) or _differs(
        count_live(session, map_id, PhotoRole.QUERY), last.labelled_queries
    )


def _is_busy(session: Session, map_id: UUID) -> bool:
    """Photos are being described, or an evaluation is under way: what is found still changes."""
    unfinished = exists().where(
        Job.map_id == map_id, Job.state.in_(UNFINISHED), Job.kind != JobKind.DESCRIBE
    )
    return bool(session.scalar(select(unfinished)))


def _has_failed(session: Session, map_id: UUID) -> bool:
    """An evaluation that can't be done is not tried for ever: its reason is in its job."""
    last = session.scalar(
        select(Job.state)
        .where(Job.map_id == map_id, Job.kind == JobKind.EVALUATE)
        .order_by(Job.id.desc())
        .limit(1)
    )
    return last in (JobState.FAILED, JobState.CANCELLED)


def _differs(now: int, then: int) -> bool:
    return abs(now - then) > CHANGED_SHARE * then
