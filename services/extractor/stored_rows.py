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

from services.extractor.target import ResolvedGeneration
from shared.catalog.chunks import find_descriptor_rows
from shared.catalog.generations import active_generation
from shared.catalog.photos import get_live_photos
from shared.catalog.session import Catalog
from shared.chunks import Row, Rows, read_row, rows_are_valid
from shared.errors import NotFound
from shared.jobs import Job, JobKind
from shared.objects import ObjectStore

log = logging.getLogger(__name__)


def read_stored_rows(
    catalog: Catalog, store: ObjectStore, generation_id: UUID, photo_ids: Sequence[UUID]
) -> dict[UUID, Row]:
    """The rows, (dimension,), of those photos that are live and described in the generation.

    A row that can't be read, or is neither of length 1 nor zero, is left out and logged: it has to
    be described anew.
    """
    with catalog.read() as session:
        live = get_live_photos(session, photo_ids)
        located = find_descriptor_rows(session, generation_id, list(live))
    rows = {}
    for object_key in sorted(located):
        for number, photo_id in located[object_key]:
            try:
                row = read_row(store, object_key, number)
            except (NotFound, IndexError, ValueError) as error:
                log.error("row %d of the chunk %s can't be read: %s", number, object_key, error)
                continue
            if rows_are_valid(row[np.newaxis]).all():
                rows[photo_id] = row
            else:
                log.error("row %d of the chunk %s is no descriptor any more", number, object_key)
    return rows


def read_rows_to_project(
    catalog: Catalog, store: ObjectStore, jobs: list[Job], target: ResolvedGeneration
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
        live = get_live_photos(session, photo_ids).keys()
    if source is None or source.spec != unprojected_spec(target):
        return None
    rows = read_stored_rows(catalog, store, source.id, photo_ids)
    if live - rows.keys():
        return None
    wanted = [(job, rows[job.photo_id]) for job in jobs if job.photo_id in rows]
    if not wanted:
        return [], np.empty((0, target.projection.dimension), np.float32)
    return [job for job, _ in wanted], np.stack([row for _, row in wanted])


def unprojected_spec(target: ResolvedGeneration) -> dict[str, Any]:
    """Of the target's descriptors before they are projected."""
    return target.extractor.spec(target.centres)
