"""Model change tasks: queue photos for a new generation, and activate it when it is complete.

A generation is complete when each live photo of the active generation has a descriptor or a
recorded failure in it. It is activated once every live search worker has loaded it. The last check
and the activation are one transaction under the map's lock, which publishing takes, too, so no
photo can be missed between them. Search workers that died are removed, or they would block it.
"""

from __future__ import annotations

import logging
from uuid import UUID

from sqlalchemy import delete, exists, func, insert, select, update
from sqlalchemy.orm import Session, aliased

from shared.catalog.chunks import Descriptor, estimate_described
from shared.catalog.database.base import Condition, db_now, db_now_plus
from shared.catalog.database.session import Catalog
from shared.catalog.generations import (
    Generation,
    GenerationState,
    active_generation,
    lock_generation,
)
from shared.catalog.jobs import MODEL_CHANGE_JOBS, UNFINISHED_STATES, WaitingFor
from shared.catalog.maps import Map, increment_map_version, list_maps, lock_map
from shared.catalog.photos import Photo, PhotoRole
from shared.catalog.processes import delete_dead_search_workers, list_lagging_workers
from shared.catalog.vocabularies import StoredWhitening, vocabulary_standing
from shared.catalog.webhooks import EventKind, enqueue_event
from shared.errors import Conflict
from shared.extractor_config.configs import MIN_PHOTOS_TO_FIT
from shared.ids import new_id
from shared.jobs import Job, JobKind, JobState, Priority, Wakeups
from shared.jobs.model_changes import start_model_change
from shared.jobs.transitions import succeed_job

log = logging.getLogger(__name__)

# A search worker that takes longer to load a generation is named in the job and in the log.
SLOW_LOAD_SECONDS = 60.0


def remove_dead_search_workers(catalog: Catalog) -> None:
    """Unregister search workers without a recent heartbeat; a paused one registers again."""
    with catalog.write() as session:
        removed = delete_dead_search_workers(session)
    if removed:
        log.warning("removed %d search workers without a recent heartbeat", removed)


def search_workers_have_loaded(session: Session, job: Job, generation: Generation) -> bool:
    """Return whether every live search worker has loaded the complete generation.

    If not, the job is set to wait for them, for as long as they live: without a worker, the photos
    that it serves would be missing from the results. A worker must have loaded the map version at
    which the generation was first complete. Photos described since then are few, and queries wait
    for them with `min_version`.
    """
    if generation.complete_version is None:
        generation.complete_version = session.get_one(Map, generation.map_id).version
        generation.complete_at = db_now()
        session.flush()
    lagging = list_lagging_workers(session, generation.id, generation.complete_version)
    if not lagging:
        return True
    job.waiting_for, job.stage = WaitingFor.SEARCH, "load"
    if _loading_is_slow(session, generation):
        names = [worker.name for worker in lagging]
        if names != job.awaited:
            log.warning(
                "generation %s is complete, but these search workers have not loaded it after "
                "%g s: %s. Its activation waits for them as long as they live; see their logs",
                generation.id,
                SLOW_LOAD_SECONDS,
                ", ".join(names),
            )
        job.awaited = names
    return False


def _loading_is_slow(session: Session, generation: Generation) -> bool:
    return bool(
        session.scalar(
            select(Generation.complete_at < db_now_plus(-SLOW_LOAD_SECONDS)).where(
                Generation.id == generation.id
            )
        )
    )


ADVANCED_WAITS = (WaitingFor.DESCRIPTORS, WaitingFor.SEARCH)

REINDEX_JOBS_PER_TRANSACTION = 2000

# The defaults of `POST /vocabularies`; without `clusters` the extractor's own number is used.
DEFAULT_FIT_PARAMS = {"clusters": None, "sample": 1000, "seed": 0}


def advance_model_changes(catalog: Catalog, wakeups: Wakeups) -> None:
    """Advance every model change that waits for descriptors or for search workers by one step."""
    with catalog.read() as session:
        waiting = session.scalars(
            select(Job).where(Job.kind.in_(MODEL_CHANGE_JOBS), Job.waiting_for.in_(ADVANCED_WAITS))
        ).all()
    for job in waiting:
        with catalog.write() as session:
            lock_map(session, job.map_id)
            current = session.get_one(Job, job.id, with_for_update=True)
            if current.waiting_for in ADVANCED_WAITS and current.generation_id:
                queued = _advance_generation(session, current, current.generation_id)
                if queued:
                    wakeups.send()


def auto_fit_vocabularies(catalog: Catalog, wakeups: Wakeups, auto_fit_photos: int) -> None:
    """Start a vocabulary fit for each map with `auto_fit_photos` photos that wait for one.

    Pooled descriptors are replaced by those of a vocabulary at the same number, a provisional
    vocabulary once the map has at least MIN_PHOTOS_TO_FIT, too.
    """
    with catalog.read() as session:
        maps = [map_.id for map_ in list_maps(session)]
        ready = [
            id_
            for id_ in maps
            if _has_enough_waiting_photos(session, id_, auto_fit_photos)
            or _has_outgrown_its_vocabulary(session, id_, auto_fit_photos)
        ]
    for map_id in ready:
        with catalog.write() as session:
            if _last_change_failed(session, map_id):
                continue  # the error is in the job; a user has to act
            try:
                job = start_model_change(session, map_id, JobKind.FIT, dict(DEFAULT_FIT_PARAMS))
            except Conflict:
                continue  # a model change is running
        log.info(
            "fitting a vocabulary for map %s, which has enough photos (job %s)", map_id, job.id
        )
        wakeups.send()


def _has_enough_waiting_photos(session: Session, map_id: UUID, min_photos: int) -> bool:
    """Return whether at least `min_photos` database photos of the map wait for a vocabulary."""
    waiting = (
        select(Job.id)
        .join(Photo, Photo.id == Job.photo_id)
        .where(
            Job.map_id == map_id,
            Job.waiting_for == WaitingFor.VOCABULARY,
            Job.kind == JobKind.INDEX,
            Photo.role == PhotoRole.DATABASE,
        )
        .limit(min_photos)
    )
    return session.scalar(select(func.count()).select_from(waiting.subquery())) == min_photos


def _has_outgrown_its_vocabulary(session: Session, map_id: UUID, min_photos: int) -> bool:
    """Return whether the map's vocabulary is pending or provisional, and it has enough photos.

    A PCA whitening was fitted on descriptors of the vocabulary, so a user has to replace both.
    """
    active = active_generation(session, map_id)
    if active is None or active.pca_from is not None:
        return False
    standing = vocabulary_standing(session, active)
    if standing not in ("pending", "provisional"):
        return False
    required = min_photos if standing == "pending" else max(min_photos, MIN_PHOTOS_TO_FIT)
    photos = (
        select(Photo.id)
        .where(
            Photo.map_id == map_id,
            Photo.deleted_at.is_(None),
            Photo.role == PhotoRole.DATABASE,
        )
        .limit(required)
    )
    return session.scalar(select(func.count()).select_from(photos.subquery())) == required


def _advance_generation(session: Session, job: Job, generation_id: UUID) -> int:
    """Queue missing photos, update the progress, or finish; return the number of queued jobs."""
    generation = lock_generation(session, generation_id)
    if generation.state == GenerationState.BUILDING:
        queued = _queue_missing_photos(session, generation)
        open_jobs = (Job.kind == JobKind.REINDEX) & (Job.generation_id == generation_id)
    else:  # the map's first generation: photos are described into it by their own jobs
        queued = 0
        open_jobs = (
            (Job.kind == JobKind.INDEX)
            & (Job.map_id == job.map_id)
            & (Job.created_at <= generation.created_at)
        )
    if queued or session.scalar(
        select(exists().where(open_jobs, Job.state.in_(UNFINISHED_STATES)))
    ):
        before = int(job.params.get("done_before", 0))
        described = estimate_described(session, generation_id)
        # Also if it was complete before: photos have been added since.
        job.waiting_for, job.stage, job.awaited = WaitingFor.DESCRIPTORS, "describe", None
        job.progress_done = max(0, min(before + described, job.progress_total - 1))
        return queued
    failed = _count_jobs(session, open_jobs & (Job.state == JobState.FAILED))
    if generation.state == GenerationState.BUILDING:
        if not search_workers_have_loaded(session, job, generation):
            return 0
        _activate_generation(session, job, generation)
    job.progress_failed = failed
    job.progress_total = max(job.progress_total, failed)
    photos = estimate_described(session, generation_id)
    whitening = None
    if generation.whitening_id is not None:
        whitening = session.get_one(StoredWhitening, generation.whitening_id).summary()
    succeed_job(
        job,
        {
            "generation_id": str(generation_id),
            "vocabulary_id": str(generation.vocabulary_id) if generation.vocabulary_id else None,
            "clusters": generation.spec["clusters"],
            "dimension": generation.dimension,
            "pca": whitening,
            "photos": photos,
            "failed": failed,
        },
    )
    log.info("activated generation %s with %d photos", generation_id, photos)
    return 0


def _queue_missing_photos(session: Session, generation: Generation) -> int:
    """Queue a reindex job for each photo without one, up to REINDEX_JOBS_PER_TRANSACTION."""
    active = active_generation(session, generation.map_id)
    assert active is not None, "a generation is built only while another is active"
    described, reindexed = aliased(Descriptor), aliased(Job)
    missing = (
        select(Photo.id)
        .join(
            Descriptor,
            (Descriptor.photo_id == Photo.id) & (Descriptor.generation_id == active.id),
        )
        .where(
            Photo.map_id == generation.map_id,
            Photo.deleted_at.is_(None),
            ~exists().where(
                described.photo_id == Photo.id, described.generation_id == generation.id
            ),
            ~exists().where(
                reindexed.photo_id == Photo.id,
                reindexed.generation_id == generation.id,
                reindexed.state != JobState.CANCELLED,  # by a user: the photo is still missing
            ),
        )
        .order_by(Photo.id)
        .limit(REINDEX_JOBS_PER_TRANSACTION)
    )
    rows = [
        {
            "id": new_id(),
            "map_id": generation.map_id,
            "kind": JobKind.REINDEX,
            "priority": Priority.REINDEX,
            "photo_id": photo_id,
            "generation_id": generation.id,
        }
        for photo_id in session.scalars(missing)
    ]
    if rows:
        session.execute(insert(Job), rows)
    return len(rows)


def _activate_generation(session: Session, job: Job, generation: Generation) -> None:
    """Make the generation that `job` built the map's active one and retire the previous one."""
    active = active_generation(session, generation.map_id)
    assert active is not None, "a generation is built only while another is active"
    active.state = GenerationState.RETIRED
    active.ended_at = db_now()
    session.flush()  # a map has one active generation at any time, also inside a transaction
    generation.state = GenerationState.ACTIVE
    generation.activated_at = db_now()
    map_ = session.get_one(Map, generation.map_id)
    if job.params.get("extractor") is not None:
        map_.extractor = generation.extractor
    enqueue_event(
        session,
        EventKind.GENERATION_SWITCHED,
        {
            "map": map_.name,
            "generation_id": str(generation.id),
            "replaced_generation_id": str(active.id),
            "extractor": generation.extractor,
        },
    )
    reindex = (Job.kind == JobKind.REINDEX) & (Job.generation_id == generation.id)
    # A failed reindex job becomes its photo's own job, so that the photo shows the error.
    failed = select(Job.photo_id, Job.id).where(reindex, Job.state == JobState.FAILED)
    for photo_id, job_id in session.execute(failed).all():
        session.execute(update(Photo).where(Photo.id == photo_id).values(job_id=job_id))
    session.execute(delete(Job).where(reindex, Job.state != JobState.FAILED))
    increment_map_version(session, generation.map_id)


def _last_change_failed(session: Session, map_id: UUID) -> bool:
    last = session.scalar(
        select(Job.state)
        .where(Job.map_id == map_id, Job.kind.in_(MODEL_CHANGE_JOBS))
        .order_by(Job.id.desc())
        .limit(1)
    )
    return last in (JobState.FAILED, JobState.CANCELLED)


def _count_jobs(session: Session, condition: Condition) -> int:
    return session.scalar(select(func.count()).select_from(Job).where(condition)) or 0
