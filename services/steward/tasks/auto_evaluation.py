"""Evaluating maps that have changed, so that their answers can say "not in this map"; and then
learning the weights of their words, where the vocabulary is their own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any
from uuid import UUID

from sqlalchemy import exists, select
from sqlalchemy.orm import Session

from shared.catalog.generations import Generation, active_generation, latest_evaluation
from shared.catalog.jobs import QUERY_JOBS, UNFINISHED_STATES
from shared.catalog.maps import get_map_statistics, list_maps, lock_map
from shared.catalog.session import Catalog
from shared.catalog.vocabularies import vocabulary_standing, word_weights_unavailable_reason
from shared.ids import new_id
from shared.jobs import Job, JobKind, JobState, Priority
from shared.word_weights.record import parse_word_weights

AUTO_SAMPLE_PHOTOS = 300  # enough for a threshold that one in twenty exceeds
REEVALUATE_SHARE = 0.2  # of the photos: more, and what was measured is out of date


@dataclass(frozen=True, slots=True)
class DueJob:
    """A job that a map should have now."""

    kind: JobKind
    params: dict[str, Any]


def evaluate_changed_maps(catalog: Catalog, least_photos: int, word_weights: bool) -> None:
    """Queue an evaluation for each map that is at rest and has changed since its last one; with
    `word_weights` also, once that is done, the learning of its weights."""
    if not least_photos:
        return
    with catalog.read() as session:
        due = [
            map_.id
            for map_ in list_maps(session)
            if _due_job(session, map_.id, least_photos, word_weights)
        ]
    for map_id in due:
        with catalog.write() as session:
            lock_map(session, map_id)
            wanted = _due_job(session, map_id, least_photos, word_weights)
            if wanted is None:
                continue  # another steward was first
            session.add(
                Job(
                    id=new_id(),
                    map_id=map_id,
                    kind=wanted.kind,
                    priority=Priority.EVALUATION,
                    params=wanted.params,
                )
            )


def _due_job(
    session: Session, map_id: UUID, least_photos: int, word_weights: bool
) -> DueJob | None:
    """The job that the map should have now, if any."""
    generation = active_generation(session, map_id)
    if generation is None or _is_busy(session, map_id):
        return None
    figures, _ = get_map_statistics(session, map_id)
    if figures.located < least_photos:
        return None
    searchable, queries = figures.searchable, figures.located_queries
    params = {
        "sample": AUTO_SAMPLE_PHOTOS,
        "seed": 0,
        "automatic": True,
        "generation_id": str(generation.id),
        "searchable": searchable,
        "labelled_queries": queries,
    }
    seen = _last_evaluated_counts(session, generation)
    if seen is None or _changed_enough(searchable, seen[0]) or _changed_enough(queries, seen[1]):
        return DueJob(JobKind.EVALUATE, params)
    if not word_weights or not _has_own_vocabulary(session, generation):
        return None
    learnt = _last_weighted_count(session, generation)
    if learnt is None or _changed_enough(searchable, learnt):
        return DueJob(JobKind.WORD_WEIGHTS, params)
    return None


def _is_busy(session: Session, map_id: UUID) -> bool:
    """Photos are being described, or an evaluation is under way: what is found still changes."""
    unfinished = exists().where(
        Job.map_id == map_id, Job.state.in_(UNFINISHED_STATES), Job.kind.not_in(QUERY_JOBS)
    )
    return bool(session.scalar(select(unfinished)))


def _has_own_vocabulary(session: Session, generation: Generation) -> bool:
    """Weights of a foreign vocabulary have never helped (benchmarks/RESULTS.md)."""
    return (
        vocabulary_standing(session, generation) == "own"
        and word_weights_unavailable_reason(session, generation) is None
    )


def _last_evaluated_counts(session: Session, generation: Generation) -> tuple[int, int] | None:
    """How many photos and labelled queries the last evaluation saw."""
    if failed := _failed_job_params(session, generation, JobKind.EVALUATE):
        return failed["searchable"], failed["labelled_queries"]
    last = latest_evaluation(session, generation.id)
    return None if last is None else (last.searchable, last.labelled_queries)


def _last_weighted_count(session: Session, generation: Generation) -> int | None:
    """Of how many photos the generation's word weights were learnt."""
    if failed := _failed_job_params(session, generation, JobKind.WORD_WEIGHTS):
        return int(failed["searchable"])
    record = parse_word_weights(generation.word_weights)
    return None if record is None else record.searchable


def _failed_job_params(
    session: Session, generation: Generation, kind: JobKind
) -> dict[str, Any] | None:
    """The parameters of the map's last job of this kind, if it was queued here and came to nothing:
    its reason is in the job, and it is not tried for ever."""
    job = session.scalar(
        select(Job)
        .where(Job.map_id == generation.map_id, Job.kind == kind)
        .order_by(Job.id.desc())
        .limit(1)
    )
    if (
        job is not None
        and job.state in (JobState.FAILED, JobState.CANCELLED)
        and job.params.get("generation_id") == str(generation.id)
        and "searchable" in job.params
    ):
        return job.params
    return None


def _changed_enough(now: int, then: int) -> bool:
    return abs(now - then) > REEVALUATE_SHARE * then
