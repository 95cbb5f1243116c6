"""Preparation and description of batches: reading, decoding, and the forward pass.

`prepare_batch` reads and decodes the photos of claimed jobs on the CPU; `describe_batch` computes
their descriptor rows. A batch that is reindexed needs no photos if its rows follow from those of
the active generation: with the same spec before PCA, they are projected; with the same spec and
more precision, they are rounded.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from uuid import UUID

import numpy as np
from sqlalchemy import select

from services.extractor.decoder_pool import DecoderPool
from services.extractor.generation_resolver import ResolvedGeneration
from shared.catalog.chunks import find_descriptor_rows
from shared.catalog.database.session import Catalog
from shared.catalog.generations import RowType, active_generation
from shared.catalog.photos import Photo, get_live_photos
from shared.descriptors.extractor import not_finite_error
from shared.descriptors.inference import PhotoTooLargeForGpu
from shared.descriptors.pca_whitening import PcaProjection
from shared.errors import NotFound, PlacewiseError
from shared.imaging.decode import DecodedPhoto
from shared.imaging.file_formats import Previews
from shared.jobs import Job, JobKind
from shared.jobs.leases import get_lease_token
from shared.storage import ObjectStore
from shared.storage.chunks import Row, Rows, read_row, rows_are_valid
from shared.storage.keys import preview_key, query_key, query_preview_key, thumbnail_key

log = logging.getLogger(__name__)


def read_stored_rows(
    catalog: Catalog, store: ObjectStore, generation_id: UUID, photo_ids: Sequence[UUID]
) -> dict[UUID, Row]:
    """Return the (dimension,) rows of those photos that are live and described in the generation.

    A row that can't be read, or whose norm is neither 1 nor 0, is left out and logged: its photo
    has to be described again.
    """
    with catalog.read() as session:
        live = get_live_photos(session, photo_ids)
        rows_by_chunk = find_descriptor_rows(session, generation_id, list(live))
    rows = {}
    for object_key in sorted(rows_by_chunk):
        for row_number, photo_id in rows_by_chunk[object_key]:
            row = read_chunk_row(store, object_key, row_number)
            if row is not None:
                rows[photo_id] = row
    return rows


def read_chunk_row(store: ObjectStore, object_key: str, row_number: int) -> Row | None:
    """Return a (dimension,) row; None, and an error in the log, if it is missing or damaged."""
    try:
        row = read_row(store, object_key, row_number)
    except (NotFound, IndexError, ValueError) as error:
        log.error("row %d of the chunk %s can't be read: %s", row_number, object_key, error)
        return None
    if rows_are_valid(row[np.newaxis]).all():
        return row
    log.error("row %d of the chunk %s is not a valid descriptor", row_number, object_key)
    return None


def _read_reusable_rows(
    catalog: Catalog, store: ObjectStore, jobs: list[Job], target: ResolvedGeneration
) -> tuple[list[Job], Rows, PcaProjection | None] | None:
    """Return REINDEX jobs, their stored (jobs, dimension) rows, and the projection that they need.

    Jobs whose photo was deleted are left out. Returns None if the photos have to be described
    instead: the target's rows do not follow from those of the active generation, or the row of a
    photo is missing.
    """
    if jobs[0].kind != JobKind.REINDEX:
        return None
    photo_ids = [job.photo_id for job in jobs if job.photo_id is not None]
    with catalog.read() as session:
        source = active_generation(session, jobs[0].map_id)
        live = get_live_photos(session, photo_ids).keys()
    if source is None:
        return None
    row_types = (source.row_type, target.generation.row_type)
    if source.spec == target.spec and row_types == (RowType.FLOAT32, RowType.FLOAT16):
        projection = None
    elif target.projection and source.spec == target.extractor.spec(target.centres):
        projection = target.projection
    else:
        return None
    rows = read_stored_rows(catalog, store, source.id, photo_ids)
    if live - rows.keys():
        return None
    jobs_with_rows = [(job, rows[job.photo_id]) for job in jobs if job.photo_id in rows]
    if not jobs_with_rows:
        return [], np.empty((0, source.dimension), np.float32), projection
    return (
        [job for job, _ in jobs_with_rows],
        np.stack([row for _, row in jobs_with_rows]),
        projection,
    )


PREVIEWS_BY_KIND = {JobKind.INDEX: Previews.ALL, JobKind.DESCRIBE: Previews.OTHER_FORMATS}


@dataclass(slots=True)
class DescribeBatch:
    """Claimed jobs of one kind, map and generation, from their preparation to publication."""

    jobs: list[Job]
    target: ResolvedGeneration
    ready: list[Job] = field(default_factory=list)
    """Jobs to describe."""
    decoded: list[DecodedPhoto] = field(default_factory=list)
    """The photos of `ready`, in the same order; empty with `stored_rows`."""
    failed: list[tuple[Job, PlacewiseError]] = field(default_factory=list)
    """Jobs whose photo can't be described, each with the reason."""
    deleted: list[Job] = field(default_factory=list)
    """Jobs whose photo was deleted meanwhile."""
    stored_rows: Rows | None = None
    """Stored rows of `ready`, used instead of decoding photos."""
    projection: PcaProjection | None = None
    """Projection of the stored rows; None if they stay as they are."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Duration of each stage."""

    @property
    def token(self) -> UUID:
        return get_lease_token(self.jobs[0])

    @property
    def kind(self) -> JobKind:
        return JobKind(self.jobs[0].kind)

    def reject(self, index: int, error: PlacewiseError) -> None:
        """Move the job at this index of `ready` to `failed`."""
        if self.stored_rows is None:
            del self.decoded[index]
        self.failed.append((self.ready.pop(index), error))

    def reject_non_finite(self, rows: Rows) -> Rows:
        """Return the rows that are finite; the jobs of the others move from `ready` to `failed`."""
        finite = np.isfinite(rows).all(axis=1)
        if finite.all():
            return rows
        for index in reversed(np.flatnonzero(~finite).tolist()):
            self.reject(index, not_finite_error())
        return rows[finite]


def prepare_batch(
    catalog: Catalog,
    store: ObjectStore,
    decoders: DecoderPool,
    jobs: list[Job],
    target: ResolvedGeneration,
) -> DescribeBatch:
    """Read and decode the photos of the claimed jobs; store thumbnails and previews of new ones.

    Query photos get a preview if their format is one that not all browsers show.

    Where possible, stored rows are read instead (`_read_reusable_rows`).
    """
    batch = DescribeBatch(jobs=jobs, target=target)
    started = time.perf_counter()
    reusable = _read_reusable_rows(catalog, store, jobs, target)
    if reusable is not None:
        batch.ready, batch.stored_rows, batch.projection = reusable
        batch.deleted = [job for job in jobs if job not in batch.ready]
        batch.seconds["read"] = time.perf_counter() - started
        return batch
    keys = _photo_object_keys(catalog, jobs)
    present: list[Job] = []

    def read_photos() -> Iterator[bytes]:
        # Read as they are decoded: a batch of the largest photos would take gigabytes.
        for job in jobs:
            read_started = time.perf_counter()
            key = keys.get(job.id)
            if key is None:
                batch.deleted.append(job)
                continue
            try:
                data = store.get(key)
            except NotFound as error:
                # Deleted since the catalog was read, or lost: `publish` checks under the map's
                # lock.
                batch.failed.append((job, error))
                continue
            finally:
                batch.seconds["read"] += time.perf_counter() - read_started
            present.append(job)
            yield data

    batch.seconds["read"] = time.perf_counter() - started
    started = time.perf_counter()
    previews = PREVIEWS_BY_KIND.get(batch.kind, Previews.NONE)
    outcomes = decoders.decode(read_photos(), target.extractor.preprocessing, previews=previews)
    for job, outcome in zip(present, outcomes, strict=True):
        if isinstance(outcome, PlacewiseError):
            batch.failed.append((job, outcome))
        else:
            batch.ready.append(job)
            batch.decoded.append(outcome)
    batch.seconds["decode"] = time.perf_counter() - started

    # Stored here and not with the chunk, while the model runs the previous batch.
    started = time.perf_counter()
    for job, decoded in zip(batch.ready, batch.decoded, strict=True):
        if batch.kind == JobKind.INDEX:
            store.put(thumbnail_key(photo_id_of(job)), decoded.thumbnail)
        if decoded.preview is not None:
            is_query = batch.kind == JobKind.DESCRIBE
            key = query_preview_key(job.id) if is_query else preview_key(photo_id_of(job))
            store.put(key, decoded.preview)
    batch.seconds["thumbnails"] = time.perf_counter() - started
    return batch


def photo_id_of(job: Job) -> UUID:
    """Return the photo of an index or reindex job."""
    assert job.photo_id is not None, "index and reindex jobs name a photo"
    return job.photo_id


def _photo_object_keys(catalog: Catalog, jobs: list[Job]) -> dict[UUID, str]:
    """Return the object key of each job's photo; deleted photos are left out."""
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
    """Compute a (n, dimension) row for each job of `ready`.

    Photos that are too large for the GPU's memory are moved to `failed` first.
    """
    target = batch.target
    while batch.ready:
        started = time.perf_counter()
        try:
            if batch.stored_rows is not None:
                rows = batch.stored_rows
                if batch.projection is not None:
                    rows = batch.projection.project(rows)
            else:
                pixels = [decoded.pixels for decoded in batch.decoded]
                rows = target.extractor.describe(pixels, target.centres, target.projection)
        except PhotoTooLargeForGpu as error:
            batch.reject(error.place, error)
            continue
        batch.seconds["describe"] = time.perf_counter() - started
        return rows
    return np.empty((0, target.generation.dimension), np.float32)
