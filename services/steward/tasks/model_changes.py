"""Model change tasks: queue photos for a new generation, and activate it when it is complete.

A generation is complete when each live photo of the active generation has a descriptor or a
recorded failure in it. It is activated once every live search worker has loaded it. The last check
and the activation are one transaction under the map's lock, which publishing takes, too, so no
photo can be missed between them.

The photos are queued by `reindex_jobs`, without that lock; the last check reads only the chunks
published since.

A model change fails as soon as it would lose more than MAX_LOST_SHARE of the searchable photos, and
the active generation stays.
"""

from __future__ import annotations

import logging
from uuid import UUID

from sqlalchemy import exists, select
from sqlalchemy.orm import Session

from services.steward.periodic_tasks import periodic_task
from services.steward.tasks.reindex_jobs import (
    ADVANCED_WAITS,
    QueuedChunks,
    has_missing_photos,
    queue_missing_photos,
    settle_photo_jobs,
)
from shared.catalog.chunks import MAX_EXACT_COUNT, Descriptor, count_searchable, estimate_described
from shared.catalog.database.base import Condition, count_rows, db_now, db_now_plus
from shared.catalog.database.session import Catalog
from shared.catalog.generations import (
    Generation,
    GenerationState,
    active_generation,
    lock_generation,
)
from shared.catalog.jobs import MODEL_CHANGE_JOBS, UNFINISHED_STATES, WaitingFor
from shared.catalog.maps import Map, increment_map_version, lock_map
from shared.catalog.photos import Photo, PhotoRole
from shared.catalog.processes import list_lagging_search_workers
from shared.catalog.vocabularies import StoredWhitening
from shared.catalog.webhooks import EventKind, enqueue_event
from shared.errors import Unprocessable
from shared.jobs import Job, JobKind, JobState, Wakeups
from shared.jobs.model_changes import abandon_generation
from shared.jobs.transitions import fail_job, succeed_job

log = logging.getLogger(__name__)

# A search worker that takes longer to load a generation is named in the job and in the log.
SLOW_LOAD_SECONDS = 60.0

MAX_LOST_SHARE = 0.01  # of the searchable photos that a model change may fail to describe
MAX_LISTED_PHOTOS = 10


def _search_workers_have_loaded(session: Session, job: Job, generation: Generation) -> bool:
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
    names = list_lagging_search_workers(session, generation.id, generation.complete_version)
    if not names:
        return True
    job.waiting_for, job.stage = WaitingFor.SEARCH, "load"
    is_slow = select(Generation.complete_at < db_now_plus(-SLOW_LOAD_SECONDS)).where(
        Generation.id == generation.id
    )
    if session.scalar(is_slow):
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


@periodic_task(0.5)
def advance_model_changes(
    catalog: Catalog, wakeups: Wakeups, queued_chunks: QueuedChunks | None = None
) -> None:
    """Advance every model change that waits for descriptors or for search workers by one step.

    `queued_chunks` is what earlier calls have queued, updated by this one. It may be lost: then all
    chunks are read again.
    """
    queued_chunks = {} if queued_chunks is None else queued_chunks
    with catalog.read() as session:
        waiting = session.scalars(
            select(Job).where(Job.kind.in_(MODEL_CHANGE_JOBS), Job.waiting_for.in_(ADVANCED_WAITS))
        ).all()
    generation_ids = {job.generation_id for job in waiting}
    for ended in queued_chunks.keys() - generation_ids:
        del queued_chunks[ended]
    for job in waiting:
        if job.generation_id is not None:
            done = queued_chunks.setdefault(job.generation_id, set())
            _advance_model_change(catalog, wakeups, job, job.generation_id, done)
    if waiting:
        ids = [job.id for job in waiting]
        now_ended = select(Job).where(Job.id.in_(ids), Job.state.not_in(UNFINISHED_STATES))
        with catalog.read() as session:
            wakeups.report(*session.scalars(now_ended))


def _advance_model_change(
    catalog: Catalog, wakeups: Wakeups, job: Job, generation_id: UUID, queued_chunks: set[UUID]
) -> None:
    with catalog.read() as session:
        generation = session.get_one(Generation, generation_id)
    all_queued = True
    if generation.state == GenerationState.BUILDING:
        queued, all_queued = queue_missing_photos(catalog, job, generation, queued_chunks)
        if queued:
            wakeups.send()
    with catalog.read() as session:
        seems_complete = all_queued and not _has_open_jobs(session, job, generation)
    with catalog.write() as session:
        if seems_complete:
            lock_map(session, job.map_id)
        job = session.get_one(Job, job.id, with_for_update=True)
        if job.waiting_for not in ADVANCED_WAITS:
            return  # cancelled, or finished by another steward
        generation = lock_generation(session, generation_id)
        loss = _check_losses(session, job, generation)
        if loss is not None:
            log.error("model change %s failed: %s", job.id, loss.detail)
            fail_job(job, loss.as_problem())
            abandon_generation(session, job)
            return
        if not seems_complete or not _is_complete(session, job, generation, queued_chunks):
            _report_progress(session, job, generation)
            return
        switched = generation.state == GenerationState.BUILDING
        _finish_model_change(session, job, generation)
    if switched:
        settle_photo_jobs(catalog)


def _open_jobs(job: Job, generation: Generation) -> Condition:
    """Condition for the jobs that describe photos into the generation."""
    if generation.state == GenerationState.BUILDING:
        return (Job.kind == JobKind.REINDEX) & (Job.generation_id == generation.id)
    # The map's first generation: photos are described into it by their own jobs.
    return (
        (Job.kind == JobKind.INDEX)
        & (Job.map_id == job.map_id)
        & (Job.created_at <= generation.created_at)
    )


def _has_open_jobs(session: Session, job: Job, generation: Generation) -> bool:
    unfinished = exists().where(_open_jobs(job, generation), Job.state.in_(UNFINISHED_STATES))
    return bool(session.scalar(select(unfinished)))


def _is_complete(
    session: Session, job: Job, generation: Generation, queued_chunks: set[UUID]
) -> bool:
    """Return whether no photo is still to be described; the caller holds the map's lock."""
    if _has_open_jobs(session, job, generation):
        return False
    if generation.state != GenerationState.BUILDING:
        return True
    return not has_missing_photos(session, generation, queued_chunks)


def _check_losses(session: Session, job: Job, generation: Generation) -> Unprocessable | None:
    """Count the job's failed photos; return the error if too many of them are searchable now."""
    failed = select(Job.id).where(_open_jobs(job, generation), Job.state == JobState.FAILED)
    job.progress_failed = count_rows(session, failed)
    active = active_generation(session, generation.map_id)
    if not job.progress_failed or active is None or active.id == generation.id:
        return None
    lost_jobs = (
        select(Job.photo_id, Job.error)
        .join(Photo, Photo.id == Job.photo_id)
        .join(Descriptor, Descriptor.photo_id == Photo.id)
        .where(
            _open_jobs(job, generation),
            Job.state == JobState.FAILED,
            Descriptor.generation_id == active.id,
            Photo.deleted_at.is_(None),
            Photo.role == PhotoRole.DATABASE,
        )
    )
    lost = count_rows(session, lost_jobs)
    searchable = estimate_described(session, active.id)
    if searchable <= MAX_EXACT_COUNT:
        searchable = count_searchable(session, active.id)  # without labelled queries
    if lost <= MAX_LOST_SHARE * searchable:
        return None
    listed = session.execute(lost_jobs.order_by(Job.id).limit(MAX_LISTED_PHOTOS)).all()
    return Unprocessable(
        "change_loses_photos",
        f"The new model can't describe {lost} of the map's {searchable} searchable photos (at most "
        f"{MAX_LOST_SHARE:.0%} may fail), so the map keeps the current one. The first failure is "
        f"that of the photo {listed[0].photo_id}: {listed[0].error['detail']} GET "
        f"/api/v1/jobs?kind=reindex&state=failed&map={session.get_one(Map, job.map_id).name} lists "
        "all. Delete or replace these photos, or use another model.",
        lost=lost,
        searchable=searchable,
        file_ids=[str(row.photo_id) for row in listed],
    )


def _report_progress(session: Session, job: Job, generation: Generation) -> None:
    before = int(job.params.get("done_before", 0))
    described = estimate_described(session, generation.id)
    # Also if it was complete before: photos have been added since.
    job.waiting_for, job.stage, job.awaited = WaitingFor.DESCRIPTORS, "describe", None
    job.progress_done = max(0, min(before + described, job.progress_total - 1))


def _finish_model_change(session: Session, job: Job, generation: Generation) -> None:
    """Activate the complete generation, unless search workers have yet to load it."""
    if generation.state == GenerationState.BUILDING:
        if not _search_workers_have_loaded(session, job, generation):
            return
        _activate_generation(session, job, generation)
    if job.kind == JobKind.IMPORT or job.params.get("vocabulary_chosen"):
        session.get_one(Map, job.map_id).auto_fit = False
    job.progress_total = max(job.progress_total, job.progress_failed)
    photos = estimate_described(session, generation.id)
    whitening = None
    if generation.whitening_id is not None:
        whitening = session.get_one(StoredWhitening, generation.whitening_id).summary()
    succeed_job(
        job,
        {
            "generation_id": str(generation.id),
            "vocabulary_id": str(generation.vocabulary_id) if generation.vocabulary_id else None,
            "clusters": generation.spec["clusters"],
            "dimension": generation.dimension,
            "pca": whitening,
            "photos": photos,
            "failed": job.progress_failed,
        },
    )
    log.info("activated generation %s with %d photos", generation.id, photos)


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
        map_.fitted_photos = None  # the photos were of another extractor's fit
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
    increment_map_version(session, generation.map_id)
