"""Handler of `index`, `reindex` and `describe` jobs: describes the photos of a batch.

A batch that is reindexed is not described again if its rows follow from those of the active
generation: with the same spec before PCA, they are projected; with the same spec and at least the
same precision, they are copied. Local features that the active generation has are copied.
"""

from __future__ import annotations

import logging
import pickle
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any
from uuid import UUID

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import select

from services.extractor.decoder_process import StoredPhoto
from services.extractor.generation_resolver import ResolvedGeneration, resolve_generation
from services.extractor.handlers import ExtractorContext, JobBatch, handles
from services.extractor.local_features import BatchFeatures, prepare_features
from services.extractor.publish import photo_id_of, publish
from shared.catalog.chunks import find_descriptor_rows
from shared.catalog.database.session import Catalog
from shared.catalog.generations import RowType, active_generation
from shared.catalog.photos import Photo, get_live_photos
from shared.descriptors.extractor import not_finite_error
from shared.descriptors.inference import PhotoTooLargeForGpu
from shared.errors import NotFound, PlacewiseError
from shared.imaging.decode import DecodedPhoto
from shared.imaging.file_formats import Previews
from shared.jobs import Job, JobKind
from shared.storage import ObjectStore
from shared.storage.chunks import Row, Rows, read_row, rows_are_valid
from shared.storage.keys import preview_key, query_key, query_preview_key, thumbnail_key

log = logging.getLogger(__name__)

PREVIEWS_BY_KIND = {JobKind.INDEX: Previews.ALL, JobKind.DESCRIBE: Previews.OTHER_FORMATS}


@handles(JobKind.INDEX, JobKind.REINDEX, JobKind.DESCRIBE)
def describe_photos(context: ExtractorContext, batch: JobBatch) -> Iterator[None]:
    """Prepare, describe and publish the photos of claimed jobs."""
    target = resolve_generation(context, batch.jobs[0])
    features = prepare_features(context, batch, target)
    photos = _read_rows(context, batch, target, features) or _read_photos(
        context, batch, target, features
    )
    yield
    with batch.timed("describe"):
        rows = photos.compute_rows(target.generation.dimension)
    if features:
        with batch.timed("features"):
            features.detect()
    yield
    with batch.timed("publish"):
        publish(context, batch, target.generation, photos.ready, photos.failed, rows, features)


@dataclass(slots=True)
class _PreparedPhotos:
    convert: Callable[[list[NDArray[Any]]], Rows]
    """Computes (n, dimension) rows of n inputs."""
    ready: list[Job] = field(default_factory=list)
    inputs: list[NDArray[Any]] = field(default_factory=list)
    """The pixels, or else a stored row, of each of the jobs in `ready`."""
    failed: list[tuple[Job, PlacewiseError]] = field(default_factory=list)
    """Jobs whose photo can't be described, each with the reason."""

    def compute_rows(self, dimension: int) -> Rows:
        """Compute a row for each job of `ready`.

        Photos that are too large for the GPU's memory, and those whose row is not finite, are moved
        to `failed`.
        """
        while self.ready:
            try:
                rows = self.convert(self.inputs)
            except PhotoTooLargeForGpu as error:
                self._reject(error.place, error)
                continue
            finite = np.isfinite(rows).all(axis=1)
            for index in reversed(np.flatnonzero(~finite).tolist()):
                self._reject(index, not_finite_error())
            return rows[finite]
        return np.empty((0, dimension), np.float32)

    def _reject(self, index: int, error: PlacewiseError) -> None:
        del self.inputs[index]
        self.failed.append((self.ready.pop(index), error))


def _read_photos(
    context: ExtractorContext,
    batch: JobBatch,
    target: ResolvedGeneration,
    features: BatchFeatures | None,
) -> _PreparedPhotos:
    """Read and decode the photos; store thumbnails and previews of new ones.

    Deleted photos are left out. Query photos get a preview if not all browsers show their format.
    """
    photos = _PreparedPhotos(
        lambda pixels: target.extractor.describe(pixels, target.centres, target.projection)
    )
    for_detection = bool(features and features.missing)
    decoded, photos.failed = _decode_photos(context, batch, batch.jobs, target, for_detection)
    for job, photo in decoded:
        photos.ready.append(job)
        photos.inputs.append(photo.pixels)
        if features:
            features.add_photo(job, photo)
    return photos


def _decode_photos(
    context: ExtractorContext,
    batch: JobBatch,
    jobs: Sequence[Job],
    target: ResolvedGeneration,
    for_detection: bool,
) -> tuple[list[tuple[Job, DecodedPhoto]], list[tuple[Job, PlacewiseError]]]:
    """Read and decode the photos of some jobs of the batch; return them and the failures.

    Deleted photos are left out.
    """
    with batch.timed("read"):
        keys = _photo_object_keys(context.catalog, batch.jobs)
    present = [job for job in jobs if job.id in keys]
    store = pickle.dumps(context.store)
    with batch.timed("decode"):
        outcomes = context.decoders.decode(
            [StoredPhoto(store, keys[job.id], *_preview_keys(job)) for job in present],
            target.extractor.preprocessing,
            previews=PREVIEWS_BY_KIND.get(batch.kind, Previews.NONE),
            for_detection=for_detection,
        )
    decoded: list[tuple[Job, DecodedPhoto]] = []
    failed: list[tuple[Job, PlacewiseError]] = []
    for job, outcome in zip(present, outcomes, strict=True):
        if isinstance(outcome, PlacewiseError):
            # Also a photo that was deleted meanwhile: `publish` checks under the map's lock.
            failed.append((job, outcome))
        else:
            decoded.append((job, outcome))
    return decoded, failed


def _preview_keys(job: Job) -> tuple[str | None, str | None]:
    if job.kind == JobKind.DESCRIBE:
        return None, query_preview_key(job.id)
    if job.kind == JobKind.INDEX:
        return thumbnail_key(photo_id_of(job)), preview_key(photo_id_of(job))
    return None, None


def _photo_object_keys(catalog: Catalog, jobs: list[Job]) -> dict[UUID, str]:
    """Return the object key of each job's photo; deleted photos are left out."""
    if jobs[0].kind == JobKind.DESCRIBE:
        return {job.id: query_key(job.id) for job in jobs}
    with catalog.read_once() as session:
        found = session.execute(
            select(Job.id, Photo.object_key)
            .join(Photo, Photo.id == Job.photo_id)
            .where(Job.id.in_([job.id for job in jobs]), Photo.deleted_at.is_(None))
        )
        return {row.id: row.object_key for row in found}


def _read_rows(
    context: ExtractorContext,
    batch: JobBatch,
    target: ResolvedGeneration,
    features: BatchFeatures | None,
) -> _PreparedPhotos | None:
    """Read stored rows instead of the photos of REINDEX jobs; deleted photos are left out.

    Photos are decoded only for local features that are missing.

    Returns None if the photos have to be described: the target's rows do not follow from those of
    the active generation, or the row of a photo is missing.
    """
    if batch.kind != JobKind.REINDEX:
        return None
    with batch.timed("read"):
        photo_ids = [photo_id_of(job) for job in batch.jobs]
        with context.catalog.read() as session:
            source = active_generation(session, batch.jobs[0].map_id)
            live = get_live_photos(session, photo_ids).keys()
        if source is None:
            return None
        row_types = (source.row_type, target.generation.row_type)
        if source.spec == target.spec and row_types != (RowType.FLOAT16, RowType.FLOAT32):
            projection = None
        elif target.projection and source.spec == target.extractor.spec(target.centres):
            projection = target.projection
        else:
            return None
        rows = read_stored_rows(context.catalog, context.store, source.id, photo_ids)
        if live - rows.keys():
            return None

    def convert(rows: list[Row]) -> Rows:
        stacked = np.stack(rows)
        return stacked if projection is None else projection.project(stacked)

    ready = [job for job in batch.jobs if job.photo_id in rows]
    if features and features.missing:
        missing = [job for job in ready if job.id in features.missing]
        decoded, failed = _decode_photos(context, batch, missing, target, True)
        for job, photo in decoded:
            features.add_photo(job, photo)
        for job, error in failed:
            log.warning("the photo %s gets no local features: %s", job.photo_id, error.detail)
    return _PreparedPhotos(convert, ready, [rows[photo_id_of(job)] for job in ready])


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
