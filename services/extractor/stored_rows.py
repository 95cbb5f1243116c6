"""Descriptor rows that are in the store already: what a PCA is fitted on, and what it shortens.

Bringing a map's photos to fewer dimensions needs no photo: the whole rows of the generation that
answers are read and projected, where they are what would be described anew.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any
from uuid import UUID

import numpy as np
from sqlalchemy import select

from services.extractor.target import Target
from shared.catalog.chunks import Chunk, Descriptor
from shared.catalog.generations import active_generation
from shared.catalog.photos import Photo
from shared.catalog.session import Catalog
from shared.chunks import Row, Rows, read_row
from shared.errors import NotFound
from shared.jobs import Job, JobKind
from shared.objects import ObjectStore

log = logging.getLogger(__name__)

UNIT_WITHIN = 1e-3  # of a stored row's length


def stored_rows(
    catalog: Catalog, store: ObjectStore, generation_id: UUID, photo_ids: Sequence[UUID]
) -> dict[UUID, Row]:
    """The rows, (dimension,), of those photos that are live and described in the generation.

    A row that can't be read, or is neither of length 1 nor zero, is left out and logged: it has to
    be described anew.
    """
    with catalog.read() as session:
        found = session.execute(
            select(Descriptor.photo_id, Descriptor.row, Chunk.object_key)
            .join(Chunk, Chunk.id == Descriptor.chunk_id)
            .join(Photo, Photo.id == Descriptor.photo_id)
            .where(
                Descriptor.generation_id == generation_id,
                Descriptor.photo_id.in_(photo_ids),
                Photo.deleted_at.is_(None),
            )
            .order_by(Chunk.object_key, Descriptor.row)
        ).all()
    rows = {}
    for photo_id, number, object_key in found:
        try:
            row = read_row(store, object_key, number)
        except (NotFound, IndexError, ValueError) as error:
            log.error("row %d of the chunk %s can't be read: %s", number, object_key, error)
            continue
        length = float(np.linalg.norm(row))
        if length == 0 or abs(length - 1) < UNIT_WITHIN:
            rows[photo_id] = row
        else:
            log.error("row %d of the chunk %s is no descriptor any more", number, object_key)
    return rows


def rows_to_project(
    catalog: Catalog, store: ObjectStore, jobs: list[Job], target: Target
) -> tuple[list[Job], Rows] | None:
    """REINDEX jobs into a generation with PCA, and their photos' whole rows, (jobs, dimension).

    Jobs whose photo was deleted are left out. None where the photos have to be described: the
    generation that answers was made otherwise, or lacks one of them.
    """
    if target.projection is None or jobs[0].kind != JobKind.REINDEX:
        return None
    photo_ids = [job.photo_id for job in jobs if job.photo_id is not None]
    with catalog.read() as session:
        source = active_generation(session, jobs[0].map_id)
        live = set(
            session.scalars(
                select(Photo.id).where(Photo.id.in_(photo_ids), Photo.deleted_at.is_(None))
            )
        )
    if source is None or source.spec != whole_spec(target):
        return None
    rows = stored_rows(catalog, store, source.id, photo_ids)
    if live - rows.keys():
        return None
    wanted = [(job, rows[job.photo_id]) for job in jobs if job.photo_id in rows]
    if not wanted:
        return [], np.empty((0, target.projection.dimension), np.float32)
    return [job for job, _ in wanted], np.stack([row for _, row in wanted])


def whole_spec(target: Target) -> dict[str, Any]:
    """Of the target's descriptors before they are projected."""
    return target.extractor.spec(target.centres)
