"""The CPU half of a batch: which generation it goes to, its bytes, its pixels.

The model half of a batch: its rows.

Descriptor rows that are in the store already: what a PCA is fitted on, and what it shortens.

Bringing a map's photos to fewer dimensions needs no photo: the whole rows of the generation that
answers are read and projected, where they are what would be described anew.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any
from uuid import UUID

import numpy as np
from sqlalchemy import select

from services.extractor.decoder_pool import DecoderPool
from services.extractor.generation_resolver import ResolvedGeneration
from shared.catalog.chunks import find_descriptor_rows
from shared.catalog.generations import active_generation
from shared.catalog.photos import Photo, get_live_photos
from shared.catalog.session import Catalog
from shared.descriptors.extractor import not_finite_error
from shared.descriptors.inference import PhotoTooLargeForGpu
from shared.errors import NotFound, PlacewiseError
from shared.imaging.decode import DecodedPhoto
from shared.imaging.preprocessing import Pixels
from shared.jobs import Job, JobKind
from shared.jobs.leases import get_lease_token
from shared.storage import ObjectStore
from shared.storage.chunks import Row, Rows, read_row, rows_are_valid
from shared.storage.keys import query_key, thumbnail_key

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


@dataclass(slots=True)
class DescribeBatch:
    """Claimed jobs of one kind, map and generation, on their way to a chunk.

    `ready` and `decoded` belong together; `failed` are jobs whose photo is at fault;
    `gone` are jobs whose photo was deleted meanwhile. With `stored`, nothing was decoded: these are
    the whole rows of `ready`, to be projected.
    """

    jobs: list[Job]
    target: ResolvedGeneration
    ready: list[Job] = field(default_factory=list)
    decoded: list[DecodedPhoto] = field(default_factory=list)
    failed: list[tuple[Job, PlacewiseError]] = field(default_factory=list)
    deleted: list[Job] = field(default_factory=list)
    stored_rows: Rows | None = None
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def token(self) -> UUID:
        return get_lease_token(self.jobs[0])

    @property
    def kind(self) -> JobKind:
        return JobKind(self.jobs[0].kind)

    def pixels(self) -> list[Pixels]:
        """Of each of `ready`, (height, width, 3)."""
        return [decoded.pixels for decoded in self.decoded]

    def reject(self, index: int, error: PlacewiseError) -> None:
        """The job at that place of `ready` goes to `failed`."""
        if self.stored_rows is None:
            del self.decoded[index]
        self.failed.append((self.ready.pop(index), error))

    def reject_non_finite(self, rows: Rows) -> Rows:
        """The rows that are finite; the jobs of the others go from `ready` to `failed`."""
        finite = np.isfinite(rows).all(axis=1)
        if finite.all():
            return rows
        for place in reversed(np.flatnonzero(~finite).tolist()):
            self.reject(place, not_finite_error())
        return rows[finite]


def prepare_batch(
    catalog: Catalog,
    store: ObjectStore,
    decoders: DecoderPool,
    jobs: list[Job],
    target: ResolvedGeneration,
) -> DescribeBatch:
    """Read and decode the photos of the claimed jobs, and store their thumbnails; or read rows that
    take their place.
    """
    batch = DescribeBatch(jobs=jobs, target=target)
    started = time.perf_counter()
    there = read_rows_to_project(catalog, store, jobs, target)
    if there is not None:
        batch.ready, batch.stored_rows = there
        batch.deleted = [job for job in jobs if job not in batch.ready]
        batch.seconds["read"] = time.perf_counter() - started
        return batch
    keys = _photo_object_keys(catalog, jobs)
    present: list[tuple[Job, bytes]] = []
    for job in jobs:
        key = keys.get(job.id)
        try:
            if key is None:
                batch.deleted.append(job)
            else:
                present.append((job, store.get(key)))
        except NotFound as error:
            # Deleted between the two reads, or lost: publishing tells which, under the map's lock.
            batch.failed.append((job, error))
    batch.seconds["read"] = time.perf_counter() - started

    started = time.perf_counter()
    outcomes = decoders.decode([data for _, data in present], target.extractor.preprocessing)
    for (job, _), outcome in zip(present, outcomes, strict=True):
        if isinstance(outcome, PlacewiseError):
            batch.failed.append((job, outcome))
        else:
            batch.ready.append(job)
            batch.decoded.append(outcome)
    batch.seconds["decode"] = time.perf_counter() - started

    if batch.kind == JobKind.INDEX:
        # Here and not with the chunk: the model is busy with the batch before.
        started = time.perf_counter()
        for job, decoded in zip(batch.ready, batch.decoded, strict=True):
            store.put(thumbnail_key(photo_id_of(job)), decoded.thumbnail)
        batch.seconds["thumbnails"] = time.perf_counter() - started
    return batch


def photo_id_of(job: Job) -> UUID:
    assert job.photo_id is not None, "index and reindex jobs name a photo"
    return job.photo_id


def _photo_object_keys(catalog: Catalog, jobs: list[Job]) -> dict[UUID, str]:
    """The key of each job's photo; deleted photos are left out."""
    if jobs[0].kind == JobKind.DESCRIBE:
        return {job.id: query_key(job.id) for job in jobs}
    with catalog.read() as session:
        found = session.execute(
            select(Job.id, Photo.object_key)
            .join(Photo, Photo.id == Job.photo_id)
            .where(Job.id.in_([job.id for job in jobs]), Photo.deleted_at.is_(None))
        )
        return {row.id: row.object_key for row in found}


def describe_batch(batch: DescribeBatch) -> Rows:
    """A row for each of the batch's `ready`, which photos that the GPU can't hold have left."""
    target = batch.target
    while batch.ready:
        started = time.perf_counter()
        try:
            if batch.stored_rows is not None:
                assert target.projection is not None
                rows = target.projection.project(batch.stored_rows)
            else:
                pixels = batch.pixels()
                rows = target.extractor.describe(pixels, target.centres, target.projection)
        except PhotoTooLargeForGpu as error:
            batch.reject(error.place, error)
            continue
        batch.seconds["describe"] = time.perf_counter() - started
        return rows
    return np.empty((0, target.generation.dimension), np.float32)
