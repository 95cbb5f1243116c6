"""Model changes' duties: queue photos for a generation that is built, switch when it is complete.

Complete means: each live photo that the active generation can find has a descriptor in the new
one, or a recorded failure there. Then every live search worker has to have loaded it. The last
check and the switch are one transaction under the map's lock, which publishing takes as well: no
photo can slip between them.
"""

from __future__ import annotations

import logging
from uuid import UUID

from sqlalchemy import delete, exists, func, insert, select, update
from sqlalchemy.orm import Session, aliased

from services.steward.search_workers import search_has_loaded
from shared.catalog.base import Condition, db_now
from shared.catalog.chunks import Descriptor, about_described
from shared.catalog.generations import (
    Generation,
    GenerationState,
    active_generation,
    lock_generation,
)
from shared.catalog.maps import Map, bump_version, list_maps, lock_map
from shared.catalog.photos import Photo, PhotoRole
from shared.catalog.session import Catalog
from shared.catalog.webhooks import EventKind, announce
from shared.catalog.whitenings import StoredWhitening
from shared.errors import Conflict
from shared.ids import new_id
from shared.jobs import Hints, Job, JobKind, JobState, Priority
from shared.jobs.finish import succeed
from shared.jobs.model_changes import start_model_change
from shared.jobs.table import MODEL_CHANGES, UNFINISHED, WaitingFor

log = logging.getLogger(__name__)

WAITING = (WaitingFor.DESCRIPTORS, WaitingFor.SEARCH)

FILL_JOBS = 2000  # reindex jobs queued in one transaction

# What `POST /vocabularies` with {} asks for; no `clusters` means the extractor's own number.
DEFAULT_FIT = {"clusters": None, "sample": 1000, "seed": 0}


def advance_model_changes(catalog: Catalog, hints: Hints) -> None:
    """One step for every model change that waits for descriptors, or for search to load them."""
    with catalog.read() as session:
        waiting = session.scalars(
            select(Job).where(Job.kind.in_(MODEL_CHANGES), Job.waiting_for.in_(WAITING))
        ).all()
    for job in waiting:
        with catalog.write() as session:
            lock_map(session, job.map_id)
            current = session.get_one(Job, job.id, with_for_update=True)
            if current.waiting_for in WAITING and current.generation_id:
                queued = _advance(session, current, current.generation_id)
                if queued:
                    hints.send()


def fit_maps_that_wait(catalog: Catalog, hints: Hints, auto_fit_photos: int) -> None:
    """A map whose photos wait for a vocabulary gets one fitted once it has enough of them."""
    with catalog.read() as session:
        maps = [map_.id for map_ in list_maps(session)]
        ready = [id_ for id_ in maps if _waiting_photos(session, id_, auto_fit_photos)]
    for map_id in ready:
        with catalog.write() as session:
            if _last_change_failed(session, map_id):
                continue  # the reason is in the job; a person has to act
            try:
                job = start_model_change(session, map_id, JobKind.FIT, dict(DEFAULT_FIT))
            except Conflict:
                continue  # one is under way
        log.info("map %s has enough photos: fitting a vocabulary (job %s)", map_id, job.id)
        hints.send()


def _waiting_photos(session: Session, map_id: UUID, least: int) -> bool:
    """Whether `least` database photos of the map wait for a vocabulary."""
    waiting = (
        select(Job.id)
        .join(Photo, Photo.id == Job.photo_id)
        .where(
            Job.map_id == map_id,
            Job.waiting_for == WaitingFor.VOCABULARY,
            Job.kind == JobKind.INDEX,
            Photo.role == PhotoRole.DATABASE,
        )
        .limit(least)
    )
    return session.scalar(select(func.count()).select_from(waiting.subquery())) == least


def _advance(session: Session, job: Job, generation_id: UUID) -> int:
    """Queue what is missing, note the progress, or finish; returns how many jobs were queued."""
    generation = lock_generation(session, generation_id)
    if generation.state == GenerationState.BUILDING:
        queued = _queue_missing(session, generation)
        open_jobs = (Job.kind == JobKind.REINDEX) & (Job.generation_id == generation_id)
    else:  # the map's first generation: photos are described into it by their own jobs
        queued = 0
        open_jobs = (
            (Job.kind == JobKind.INDEX)
            & (Job.map_id == job.map_id)
            & (Job.created_at <= generation.created_at)
        )
    if queued or session.scalar(select(exists().where(open_jobs, Job.state.in_(UNFINISHED)))):
        before = int(job.params.get("done_before", 0))
        done = about_described(session, generation_id)
        # Also when it was complete before: photos have come since.
        job.waiting_for, job.stage, job.awaited = WaitingFor.DESCRIPTORS, "describe", None
        job.progress_done = max(0, min(before + done, job.progress_total - 1))
        return queued
    failed = _count(session, open_jobs & (Job.state == JobState.FAILED))
    if generation.state == GenerationState.BUILDING:
        if not search_has_loaded(session, job, generation):
            return 0
        _switch(session, generation)
    job.progress_failed = failed
    job.progress_total = max(job.progress_total, failed)
    photos = about_described(session, generation_id)
    whitening = None
    if generation.whitening_id is not None:
        whitening = session.get_one(StoredWhitening, generation.whitening_id).in_short()
    succeed(
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
    log.info("generation %s answers, with %d photos", generation_id, photos)
    return 0


def _queue_missing(session: Session, generation: Generation) -> int:
    """A reindex job for each photo that still needs one; up to FILL_JOBS of them."""
    active = active_generation(session, generation.map_id)
    assert active is not None, "a generation is built only beside an active one"
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
                reindexed.state != JobState.CANCELLED,  # by someone, alone: the photo is missing
            ),
        )
        .order_by(Photo.id)
        .limit(FILL_JOBS)
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


def _switch(session: Session, generation: Generation) -> None:
    """The new generation answers from this commit on."""
    active = active_generation(session, generation.map_id)
    assert active is not None, "a generation is built only beside an active one"
    active.state = GenerationState.RETIRED
    active.ended_at = db_now()
    session.flush()  # one generation of a map may be active at a time, also inside a transaction
    generation.state = GenerationState.ACTIVE
    generation.activated_at = db_now()
    map_ = session.get_one(Map, generation.map_id)
    map_.extractor = generation.extractor
    announce(
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
    # A photo that could not be described anew says so through its own job from now on.
    failed = select(Job.photo_id, Job.id).where(reindex, Job.state == JobState.FAILED)
    for photo_id, job_id in session.execute(failed).all():
        session.execute(update(Photo).where(Photo.id == photo_id).values(job_id=job_id))
    session.execute(delete(Job).where(reindex, Job.state != JobState.FAILED))
    bump_version(session, generation.map_id)


def _last_change_failed(session: Session, map_id: UUID) -> bool:
    last = session.scalar(
        select(Job.state)
        .where(Job.map_id == map_id, Job.kind.in_(MODEL_CHANGES))
        .order_by(Job.id.desc())
        .limit(1)
    )
    return last in (JobState.FAILED, JobState.CANCELLED)


def _count(session: Session, condition: Condition) -> int:
    return session.scalar(select(func.count()).select_from(Job).where(condition)) or 0
