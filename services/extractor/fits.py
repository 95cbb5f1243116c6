"""Vocabulary and PCA fits, each computed by a child process while the worker goes on describing.

`FitWorker` runs in a thread of its own. It chooses the photos or rows to fit on, lets a child
compute the fit (`compute_fit`), and creates the vocabulary or whitening with its generation in one
transaction. Nothing is stored before: a fit whose worker dies starts again.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from uuid import UUID

import numpy as np
import torch
from sqlalchemy import select

from services.extractor.added_models import AddedModelLoader
from services.extractor.child_process import run_in_child
from services.extractor.decoder_pool import DecoderPool
from services.extractor.model_registry import DescriptorPipeline, ModelRegistry
from services.extractor.new_generations import (
    map_extractor,
    start_generation_with_new_vocabulary,
    start_whitened_generation,
)
from services.extractor.prepare import read_chunk_row
from shared.catalog.chunks import Descriptor, find_descriptor_rows
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation
from shared.catalog.jobs import FIT_JOBS
from shared.catalog.photos import Photo, PhotoRole
from shared.catalog.tables import open_catalog
from shared.catalog.vocabularies import Vocabulary, VocabularyOrigin, get_pca_source_generation
from shared.config.settings import Settings
from shared.descriptors.patches import fit_vocabulary, sample_photos
from shared.descriptors.pca_fit import (
    check_pca_fittable,
    fit_pca_stream,
    sample_rows,
    sample_size,
)
from shared.descriptors.pca_whitening import PcaProjection, PcaWhitening, PcaWhiteningFile, Rows
from shared.descriptors.vocabulary_file import VocabularyFile
from shared.errors import Conflict, NotFound, PlacewiseError, Unprocessable
from shared.extractor_config.configs import MIN_PHOTOS_TO_FIT
from shared.imaging.preprocessing import Pixels
from shared.jobs import Job, JobKind
from shared.jobs.leases import get_lease_token, lock_leased_jobs
from shared.jobs.runner import JobInterrupted, JobRunner, StepOutcome
from shared.storage import ObjectStore
from shared.storage.open_store import open_store

FIT_PROGRESS_UNITS = 100  # units of job progress for the fit itself: its steps in per cent
PROGRESS_SECONDS = 0.5  # between two updates of the job's progress
READ_BATCH_BYTES = 16_000_000  # of descriptor rows read at once
PCA_SEED = 0
STAGES = {
    "describing": "sample",
    "clustering": "cluster",
    "gathering": "gather",
    "reducing": "reduce",
}
"""Job stages by those of `fit_vocabulary` and `fit_pca_stream`."""

Report = Callable[[str, int, int], None]
"""Called with a stage, the steps done and their total."""


@dataclass(frozen=True, slots=True)
class VocabularyFitRequest:
    """A vocabulary to fit: on which photos, with what."""

    extractor: str
    photos: Sequence[str]
    """object keys, in random order"""
    clusters: int
    seed: int


@dataclass(frozen=True, slots=True)
class PcaFitRequest:
    """A PCA whitening to fit: on which descriptors, to how many dimensions."""

    rows: Sequence[tuple[str, int]]
    """object keys of chunks, and rows in them"""
    dimension: int
    components: int


FitRequest = VocabularyFitRequest | PcaFitRequest
Fitted = VocabularyFile | PcaWhitening


def compute_fit(
    request: FitRequest,
    store: ObjectStore,
    models: ModelRegistry,
    decoders: DecoderPool,
    batch_photos: int,
    report: Report,
) -> Fitted:
    """Compute a fit; photos and rows that are gone or damaged are left out.

    Raises:
        Unprocessable: As `fit_vocabulary` and `fit_pca_stream` raise it.
    """
    if isinstance(request, PcaFitRequest):
        return fit_pca_stream(
            _read_rows(store, request),
            len(request.rows),
            request.dimension,
            request.components,
            report,
        )
    extractor = models.extractor(request.extractor)

    def decode_batches() -> Iterator[list[Pixels]]:
        for begin in range(0, len(request.photos), batch_photos):
            photos = _read_photos(store, request.photos[begin : begin + batch_photos])
            decoded = decoders.decode(photos, extractor.preprocessing)
            batch = [photo.pixels for photo in decoded if not isinstance(photo, PlacewiseError)]
            if batch:
                yield batch

    return fit_vocabulary(
        extractor,
        decode_batches(),
        len(request.photos),
        clusters=request.clusters,
        seed=request.seed,
        on_progress=report,
    )


def _read_photos(store: ObjectStore, keys: Sequence[str]) -> Iterator[bytes]:
    for key in keys:
        with contextlib.suppress(NotFound):  # deleted since
            yield store.get(key)


def _read_rows(store: ObjectStore, request: PcaFitRequest) -> Iterator[Rows]:
    batch_rows = max(1, READ_BATCH_BYTES // (4 * request.dimension))
    for begin in range(0, len(request.rows), batch_rows):
        batch = request.rows[begin : begin + batch_rows]
        rows = [row for key, n in batch if (row := read_chunk_row(store, key, n)) is not None]
        yield np.array(rows, np.float32).reshape(-1, request.dimension)


def _compute_in_this_process(request: FitRequest, settings: Settings, report: Report) -> Fitted:
    """Compute a fit with a catalog, a store and a model of its own."""
    # Half of the processors are left to queries and photos.
    torch.set_num_threads(max(1, (os.cpu_count() or 1) // 2))
    settings = settings.model_copy(update={"decode_processes": 1})
    with contextlib.ExitStack() as stack:
        catalog = stack.enter_context(contextlib.closing(open_catalog(settings, "fit")))
        store = open_store(settings, exclusive=False)
        models = ModelRegistry(store, settings, AddedModelLoader(catalog, store, settings).load)
        decoders = stack.enter_context(contextlib.closing(DecoderPool(settings)))
        return compute_fit(request, store, models, decoders, settings.batch_photos, report)


class FitProgress:
    """Progress and cancellation of a claimed fit: its photos or rows first, then its steps."""

    def __init__(self, catalog: Catalog, job: Job, stop: threading.Event, sampled: int) -> None:
        self._catalog = catalog
        self._job = job
        self._stop = stop
        self._sampled = sampled
        self._stage: str | None = None
        self._done = 0
        self._written = 0.0

    def report(self, stage: str, done: int, total: int) -> None:
        """Note the progress of a stage (`STAGES`); raises as `check` does."""
        self._stage = STAGES[stage]
        if self._stage in ("sample", "gather"):
            self._done = min(done, self._sampled)
        else:
            self._done = self._sampled + FIT_PROGRESS_UNITS * done // max(1, total)
        self.check()

    def check(self) -> None:
        """Store the progress from time to time.

        Raises:
            JobInterrupted: The job lost its lease (it was cancelled, say), or the worker stops.
        """
        if self._stop.is_set():
            raise JobInterrupted
        if time.monotonic() - self._written < PROGRESS_SECONDS:
            return
        self._written = time.monotonic()
        with self._catalog.write() as session:
            leased = lock_leased_jobs(session, get_lease_token(self._job), [self._job])
            for job in leased:
                job.stage, job.progress_done = self._stage, self._done
        if not leased:
            raise JobInterrupted


ComputeFit = Callable[[FitRequest, Settings, FitProgress], Fitted]


def compute_in_child(request: FitRequest, settings: Settings, progress: FitProgress) -> Fitted:
    """Compute a fit in a child process; raises as `run_in_child` does."""
    return run_in_child(
        _compute_in_this_process,
        request,
        settings,
        on_progress=progress.report,
        check=progress.check,
    )


class FitWorker:
    """Runs vocabulary and PCA fits one after the other."""

    def __init__(
        self,
        catalog: Catalog,
        store: ObjectStore,
        models: ModelRegistry,
        settings: Settings,
        name: str,
        on_outcome: Callable[[JobKind, StepOutcome, int], object],
        compute: ComputeFit = compute_in_child,
    ) -> None:
        self._catalog = catalog
        self._store = store
        self._models = models
        self._settings = settings
        self._compute = compute
        self._runner = JobRunner(catalog, settings, name, FIT_JOBS, on_outcome)

    def run(self, stop: threading.Event) -> None:
        """Run fits until `stop` is set."""
        self._runner.run_jobs(lambda job: self._fit(job, stop), stop)

    def run_next(self, stop: threading.Event) -> bool:
        """Run the next fit; False when there is none."""
        return self._runner.run_next(lambda job: self._fit(job, stop))

    def _fit(self, job: Job, stop: threading.Event) -> None:
        fit = self._fit_vocabulary if job.kind == JobKind.FIT else self._fit_whitening
        fit(job, stop)

    def _fit_vocabulary(self, job: Job, stop: threading.Event) -> None:
        extractor = map_extractor(self._catalog, self._models, job)
        if not extractor.config.needs_vocabulary:
            raise Unprocessable(
                "vocabulary_unusable",
                f"The extractor {extractor.config.name} uses no vocabulary: "
                "there is nothing to fit.",
            )
        with self._catalog.read() as session:
            keys = session.scalars(
                select(Photo.object_key)
                .where(
                    Photo.map_id == job.map_id,
                    Photo.deleted_at.is_(None),
                    Photo.role == PhotoRole.DATABASE,
                )
                .order_by(Photo.id)
            ).all()
        if not keys:
            raise Conflict(
                "no_photos",
                "The map has no photos to fit a vocabulary on. Upload photos first.",
            )
        width, seed = extractor.backbone.width, job.params["seed"]
        chosen = sample_photos(len(keys), job.params["sample"], width, seed)
        request = VocabularyFitRequest(
            extractor.config.name,
            [keys[index] for index in chosen],
            job.params["clusters"] or extractor.config.clusters,
            seed,
        )
        progress = self._begin(job, stop, len(chosen), len(keys))
        fitted = self._compute(request, self._settings, progress)
        assert isinstance(fitted, VocabularyFile)
        start_generation_with_new_vocabulary(
            self._catalog,
            self._store,
            job,
            extractor,
            fitted.centres,
            VocabularyOrigin.FITTED,
            {**fitted.provenance, "provisional": len(keys) < MIN_PHOTOS_TO_FIT},
            progress_done=len(chosen) + FIT_PROGRESS_UNITS,
        )

    def _fit_whitening(self, job: Job, stop: threading.Event) -> None:
        with self._catalog.read() as session:
            source = get_pca_source_generation(session, job.map_id)
            photo_ids = session.scalars(
                select(Descriptor.photo_id)
                .join(Photo, Photo.id == Descriptor.photo_id)
                .where(
                    Descriptor.generation_id == source.id,
                    Photo.deleted_at.is_(None),
                    Photo.role == PhotoRole.DATABASE,  # never of queries
                )
                .order_by(Descriptor.photo_id)
            ).all()
        pipeline = self._source_pipeline(source)
        if pipeline.spec != source.spec:
            # The projection of stored rows would not fit new ones.
            raise Conflict(
                "spec_differs",
                "The map's photos were described by another release than this worker's. Reindex "
                "them first (POST /api/v1/generations with the vocabulary alone).",
                generation_id=str(source.id),
            )
        components = job.params["pca"]
        check_pca_fittable(len(photo_ids), source.dimension, components)
        size = sample_size(source.dimension, components)
        chosen = [photo_ids[index] for index in sample_rows(len(photo_ids), size, PCA_SEED)]
        request = PcaFitRequest(self._locate_rows(source, chosen), source.dimension, components)
        progress = self._begin(job, stop, len(chosen), len(photo_ids))
        whitening = self._compute(request, self._settings, progress)
        assert isinstance(whitening, PcaWhitening)
        projection = PcaProjection(whitening, pipeline.extractor.backbone.device)
        start_whitened_generation(
            self._catalog,
            self._store,
            job,
            DescriptorPipeline(pipeline.extractor, pipeline.centres, projection),
            PcaWhiteningFile(whitening, source.spec),
            source.vocabulary_id,
            progress_done=len(chosen) + FIT_PROGRESS_UNITS,
        )

    def _source_pipeline(self, source: Generation) -> DescriptorPipeline:
        vocabulary = None
        if source.vocabulary_id is not None:
            with self._catalog.read() as session:
                vocabulary = session.get_one(Vocabulary, source.vocabulary_id)
        return self._models.pipeline_of_generation(source, vocabulary, None)

    def _locate_rows(self, source: Generation, photo_ids: Sequence[UUID]) -> list[tuple[str, int]]:
        """Return the chunk and the row of each photo, in the order of the photos."""
        with self._catalog.read() as session:
            chunks = find_descriptor_rows(session, source.id, photo_ids)
        located = {photo: (key, row) for key, rows in chunks.items() for row, photo in rows}
        return [located[photo] for photo in photo_ids if photo in located]

    def _begin(self, job: Job, stop: threading.Event, sampled: int, photos: int) -> FitProgress:
        """Set the job's total: what is fitted on, the fit, and the photos to describe with it."""
        with self._catalog.write() as session:
            for leased in lock_leased_jobs(session, get_lease_token(job), [job]):
                leased.progress_done = 0
                leased.progress_total = sampled + FIT_PROGRESS_UNITS + photos
        return FitProgress(self._catalog, job, stop, sampled)
