"""Chunks of a building generation that are damaged: their photos are described again.

A generation is switched in once every live search worker has loaded it without a gap. A chunk that
nobody can read would hold that up for ever, so its photos go back to the extractors. A chunk of the
active generation is left to `placewise verify --repair`.
"""

from __future__ import annotations

import logging
from functools import partial
from uuid import UUID

from sqlalchemy import select
from sqlalchemy.orm import Session

from services.steward.tasks import model_changes as search_workers
from shared.catalog.base import db_now_plus
from shared.catalog.chunks import Chunk
from shared.catalog.generations import Generation, GenerationState
from shared.catalog.jobs import MODEL_CHANGE_JOBS, UNFINISHED_STATES
from shared.catalog.processes import unreadable_keys
from shared.catalog.session import Catalog
from shared.errors import NotFound, PlacewiseError, Unavailable
from shared.integrity.verify import discard_chunk
from shared.jobs import Job
from shared.jobs.model_changes import abandon_generation
from shared.jobs.transitions import fail_job
from shared.storage import ObjectStore
from shared.storage.chunks import CORRUPT, read_chunk

log = logging.getLogger(__name__)

MAX_MENDED_CHUNKS = 10  # of one model change; more, and the store is at fault
MENDED = "mended_chunks"
"""In the params of a model change: how many chunks were described again."""


def mend_generations(catalog: Catalog, store: ObjectStore) -> None:
    """Give up the chunks that a live search worker has reported for SLOW_SECONDS and that this
    process finds damaged or missing, too. A model change with more than MAX_MENDED_CHUNKS of them
    fails (`chunk_corrupt`)."""
    with catalog.read() as session:
        reported = session.scalars(
            select(Chunk)
            .join(Generation, Generation.id == Chunk.generation_id)
            .where(
                Chunk.object_key.in_(unreadable_keys(session)),
                Chunk.superseded_at.is_(None),
                Generation.state == GenerationState.BUILDING,
                Generation.complete_at < db_now_plus(-search_workers.SLOW_LOAD_SECONDS),
            )
        ).all()
    for chunk in reported:
        error = _damage(store, chunk)
        if error is not None:
            catalog.run(partial(_mend, chunk_id=chunk.id, error=error))


def _damage(store: ObjectStore, chunk: Chunk) -> PlacewiseError | None:
    """What is wrong with the chunk; None where nothing is, or where the store is away."""
    try:
        read_chunk(store, chunk.object_key, chunk.sha256)
    except NotFound as error:
        return error
    except Unavailable as error:
        return error if error.code == CORRUPT else None
    return None


def _mend(session: Session, chunk_id: UUID, error: PlacewiseError) -> None:
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
    mended = int(job.params.get(MENDED, 0)) + 1
    if mended > MAX_MENDED_CHUNKS:
        fail_job(job, error.as_problem())
        abandon_generation(session, job)
        log.error("the model change %s fails: %s", job.id, error)
        return
    job.params = {**job.params, MENDED: mended}
    # It is complete again once those photos are described: search has to load them, too.
    generation.complete_version = generation.complete_at = None
    log.warning("%s; its %d photos are described again", error, photos)
