"""Repair of building generations: describes the photos of damaged chunks again.

A generation is activated once every live search worker has loaded all of it. An unreadable chunk
would block that forever, so its photos are queued for the extractors again. Chunks of the active
generation are repaired by `placewise storage verify --repair`.
"""

from __future__ import annotations

import logging
from functools import partial
from uuid import UUID

from sqlalchemy import select
from sqlalchemy.orm import Session

from services.steward.periodic_tasks import periodic_task
from services.steward.tasks import model_changes
from shared.catalog.chunks import Chunk
from shared.catalog.database.base import db_now_plus
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation, GenerationState
from shared.catalog.jobs import MODEL_CHANGE_JOBS, UNFINISHED_STATES
from shared.catalog.processes import unreadable_keys
from shared.errors import NotFound, PlacewiseError, Unavailable
from shared.integrity.verify import discard_chunk
from shared.jobs import Job
from shared.jobs.model_changes import abandon_generation
from shared.jobs.transitions import fail_job
from shared.storage import ObjectStore
from shared.storage.chunks import CORRUPT, read_chunk

log = logging.getLogger(__name__)

MAX_REPAIRED_CHUNKS = 10  # per model change; with more, the store itself is faulty
REPAIRED_PARAM = "repaired_chunks"
"""Key in the params of a model change: the number of chunks described again."""


@periodic_task(5.0)
def repair_generations(catalog: Catalog, store: ObjectStore) -> None:
    """Drop damaged chunks of building generations and queue their photos again.

    A chunk is dropped when a live search worker reports it as unreadable, the generation has been
    complete for SLOW_LOAD_SECONDS, and this process finds it damaged or missing, too. A model
    change with more than MAX_REPAIRED_CHUNKS such chunks fails (`chunk_corrupt`).
    """
    with catalog.read() as session:
        reported = session.scalars(
            select(Chunk)
            .join(Generation, Generation.id == Chunk.generation_id)
            .where(
                Chunk.object_key.in_(unreadable_keys(session)),
                Chunk.superseded_at.is_(None),
                Generation.state == GenerationState.BUILDING,
                Generation.complete_at < db_now_plus(-model_changes.SLOW_LOAD_SECONDS),
            )
        ).all()
    for chunk in reported:
        error = _read_error(store, chunk)
        if error is not None:
            catalog.run(partial(_repair, chunk_id=chunk.id, error=error))


def _read_error(store: ObjectStore, chunk: Chunk) -> PlacewiseError | None:
    """Return the error of a damaged or missing chunk; None if another or no error occurs."""
    try:
        read_chunk(store, chunk.object_key, chunk.sha256)
    except NotFound as error:
        return error
    except Unavailable as error:
        return error if error.code == CORRUPT else None
    return None


def _repair(session: Session, chunk_id: UUID, error: PlacewiseError) -> None:
    photos = discard_chunk(session, chunk_id)
    chunk = session.get_one(Chunk, chunk_id)
    generation = session.get_one(Generation, chunk.generation_id)
    job = session.scalar(
        select(Job)
        .where(
            Job.generation_id == generation.id,
            Job.kind.in_(MODEL_CHANGE_JOBS),
            Job.state.in_(UNFINISHED_STATES),
        )
        .with_for_update()
    )
    if job is None or generation.state != GenerationState.BUILDING:
        return
    repaired = int(job.params.get(REPAIRED_PARAM, 0)) + 1
    if repaired > MAX_REPAIRED_CHUNKS:
        fail_job(job, error.as_problem())
        abandon_generation(session, job)
        log.error("model change %s failed: %s", job.id, error)
        return
    job.params = {**job.params, REPAIRED_PARAM: repaired}
    # Complete again once those photos are described: search workers have to load them, too.
    generation.complete_version = generation.complete_at = None
    log.warning("%s; its %d photos are queued to be described again", error, photos)
