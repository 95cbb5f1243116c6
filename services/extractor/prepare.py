"""The CPU half of a batch: which generation it goes to, its bytes, its pixels."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from uuid import UUID

import numpy as np
from sqlalchemy import select

from services.extractor.decoding import DecoderPool
from services.extractor.stored_rows import read_rows_to_project
from services.extractor.target import ResolvedGeneration
from shared.catalog.photos import Photo
from shared.catalog.session import Catalog
from shared.chunks import Rows
from shared.errors import NotFound, PlacewiseError
from shared.jobs import Job, JobKind
from shared.jobs.leases import get_lease_token
from shared.objects import ObjectStore
from shared.objects.keys import query_key, thumbnail_key
from shared.vision.decode import DecodedPhoto
from shared.vision.extractors import not_finite_error
from shared.vision.resample import Pixels


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
