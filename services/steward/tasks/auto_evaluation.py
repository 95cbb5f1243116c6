"""Automatic evaluation: queues evaluations for maps that have changed."""

from __future__ import annotations

from typing import Any
from uuid import UUID

from sqlalchemy import exists, select
from sqlalchemy.orm import Session

from services.steward.periodic_tasks import periodic_task
from services.steward.tasks.auto_fit import is_fit_due
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation, active_generation, latest_evaluation
from shared.catalog.jobs import UNFINISHED_STATES
from shared.catalog.maps import Map, get_map_statistics, list_maps, lock_map
from shared.config.settings import Settings
from shared.evaluation.places.probability import PlaceModel
from shared.jobs import Job, JobKind, JobState

AUTO_SAMPLE_PHOTOS = 300  # enough for a threshold at a false-accept rate of 5 %
REEVALUATE_SHARE = 0.2  # change of the photo count after which a map is evaluated again


@periodic_task(2.0)
def evaluate_changed_maps(catalog: Catalog, settings: Settings) -> None:
    """Queue an evaluation for each idle map that has changed enough since its last one.

    Maps with fewer geotagged photos than AUTO_EVALUATE_PHOTOS are skipped; 0 turns automatic
    evaluation off.
    """
    min_photos = settings.auto_evaluate_photos
    if not min_photos:
        return
    with catalog.read() as session:
        due = [map_.id for map_ in list_maps(session) if _due_params(session, map_.id, min_photos)]
    for map_id in due:
        with catalog.write() as session:
            lock_map(session, map_id)
            params = _due_params(session, map_id, min_photos)
            if params is None:
                continue  # another steward has queued it
            session.add(Job(map_id=map_id, kind=JobKind.EVALUATE, params=params))


def _due_params(session: Session, map_id: UUID, min_photos: int) -> dict[str, Any] | None:
    """Return the params of the evaluation that the map needs now, if any."""
    generation = active_generation(session, map_id)
    if generation is None or _is_busy(session, map_id):
        return None
    statistics, _ = get_map_statistics(session, map_id)
    if statistics.located < min_photos:
        return None
    if is_fit_due(session, session.get_one(Map, map_id)):
        return None  # which makes a generation that has to be evaluated anyway
    searchable, queries = statistics.searchable, statistics.located_queries
    params = {
        "sample": AUTO_SAMPLE_PHOTOS,
        "seed": 0,
        "automatic": True,
        "generation_id": str(generation.id),
        "searchable": searchable,
        "labelled_queries": queries,
    }
    evaluated = _last_evaluated_counts(session, generation)
    if (
        evaluated is None
        or _changed_enough(searchable, evaluated[0])
        or _changed_enough(queries, evaluated[1])
        or _levels_changed(session, generation)
    ):
        return params
    return None


def _is_busy(session: Session, map_id: UUID) -> bool:
    """Return whether the map has unfinished jobs other than queries, which may change results."""
    unfinished = exists().where(
        Job.map_id == map_id, Job.state.in_(UNFINISHED_STATES), Job.kind != JobKind.DESCRIBE
    )
    return bool(session.scalar(select(unfinished)))


def _last_evaluated_counts(session: Session, generation: Generation) -> tuple[int, int] | None:
    """Return the numbers of photos and of labelled queries at the last evaluation."""
    if failed := _failed_params(session, generation):
        return failed["searchable"], failed["labelled_queries"]
    last = latest_evaluation(session, generation.id)
    return None if last is None else (last.searchable, last.labelled_queries)


def _failed_params(session: Session, generation: Generation) -> dict[str, Any] | None:
    """Return the params of the map's last evaluation if it was queued here and failed.

    It counts as done, or it would be queued again in every run; its error is in the job.
    """
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
        and "searchable" in job.params
    ):
        return job.params
    return None


def _levels_changed(session: Session, generation: Generation) -> bool:
    """Return whether labels have become paths, or names, since the place model was fitted."""
    if generation.calibration is None or _failed_params(session, generation):
        return False
    model = PlaceModel.model_validate(generation.calibration)
    are_paths = session.get_one(Map, generation.map_id).place_labels_are_paths
    return bool(model and model.scheme and model.scheme.labels_are_paths != are_paths)


def _changed_enough(current: int, previous: int) -> bool:
    return abs(current - previous) > REEVALUATE_SHARE * previous
