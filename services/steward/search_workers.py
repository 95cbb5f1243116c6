"""Search workers' duties: dead ones are forgotten, live ones are waited for before a switch."""

from __future__ import annotations

import logging

from sqlalchemy import select
from sqlalchemy.orm import Session

from shared.catalog.base import db_now, db_now_plus
from shared.catalog.generations import Generation
from shared.catalog.maps import Map
from shared.catalog.search_workers import delete_dead_search_workers, list_lagging_workers
from shared.catalog.session import Catalog
from shared.jobs import Job
from shared.jobs.table import WaitingFor

log = logging.getLogger(__name__)

# Loading takes as long as reading; who takes longer than this is named, so that someone looks.
SLOW_LOAD_SECONDS = 60.0


def remove_dead_search_workers(catalog: Catalog) -> None:
    """Those that have not been heard of for long; a worker that only paused registers anew."""
    with catalog.write() as session:
        gone = delete_dead_search_workers(session)
    if gone:
        log.warning("%d search workers were not heard of for long: forgotten", gone)


def search_workers_have_loaded(session: Session, job: Job, generation: Generation) -> bool:
    """Whether every live search worker can answer from the complete generation; if not, the job
    waits for them.

    What counts is the version at which the generation was complete for the first time: photos
    that were described since are few, and queries wait for them by `min_version`. A worker that
    is alive is waited for as long as it takes: switching without it would lose its photos.
    """
    if generation.complete_version is None:
        generation.complete_version = session.get_one(Map, generation.map_id).version
        generation.complete_at = db_now()
        session.flush()
    behind = list_lagging_workers(session, generation.id, generation.complete_version)
    if not behind:
        return True
    job.waiting_for, job.stage = WaitingFor.SEARCH, "load"
    if _loading_is_slow(session, generation):
        names = [worker.name for worker in behind]
        if names != job.awaited:
            log.warning(
                "generation %s is complete, and these search workers have not loaded it for %g s: "
                "%s. The switch waits for them as long as they live; their logs say what they lack",
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
