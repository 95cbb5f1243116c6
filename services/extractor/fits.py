"""Vocabulary and PCA fits, each computed by a child process while the worker goes on describing.

`FitWorker` runs in a thread of its own. It chooses the photos or rows to fit on, lets a child
compute the fit (`compute_fit`), and creates the vocabulary or whitening with its generation in one
transaction. Nothing is stored before: a fit whose worker dies starts again. The thread also runs
reconstructions, which store their steps (`services.extractor.geometry.job`).
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from sqlalchemy import select

from services.extractor.added_models import AddedModelLoader
from services.extractor.child_process import run_in_child
from services.extractor.decoder_pool import DecoderPool
from services.extractor.describe import read_chunk_row
from services.extractor.geometry.job import ReconstructionJob
from services.extractor.handlers import ExtractorContext
from services.extractor.model_changes import NewVocabulary, map_extractor, start_generation
from services.extractor.model_registry import DescriptorPipeline, ModelRegistry
from shared.catalog.chunks import Descriptor, find_descriptor_rows
from shared.catalog.jobs import FIT_WORKER_JOBS
from shared.catalog.photos import Photo, PhotoRole
from shared.catalog.tables import open_catalog
from shared.catalog.vocabularies import VocabularyOrigin, get_pca_source_generation
from shared.config.settings import Settings, usable_processors
from shared.descriptors.patches import fit_vocabulary, sample_photos
from shared.descriptors.pca_fit import check_pca_fittable, fit_pca_stream, sample_rows, sample_size
from shared.descriptors.pca_whitening import PcaProjection, PcaWhitening, PcaWhiteningFile, Rows
from shared.descriptors.vocabulary_file import VocabularyFile
from shared.errors import Conflict, NotFound, PlacewiseError, Unprocessable
from shared.extractor_config.configs import MIN_PHOTOS_TO_FIT
from shared.imaging.preprocessing import Pixels
from shared.jobs import Job, JobKind, Wakeups
from shared.jobs.progress import JobProgress
from shared.jobs.runner import JobRunner, StepOutcome
from shared.storage import ObjectStore
from shared.storage.open_store import open_store

FIT_PROGRESS_UNITS = 100  # units of job progress for the fit itself: its steps in per cent
READ_BATCH_BYTES = 16_000_000  # of descriptor rows read at once
PCA_SEED = 0

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
    torch.set_num_threads(max(1, usable_processors() // 2))
    settings = settings.model_copy(update={"decode_processes": 1})
    with contextlib.ExitStack() as stack:
        catalog = stack.enter_context(contextlib.closing(open_catalog(settings, "fit")))
        store = open_store(settings, exclusive=False)
        models = ModelRegistry(store, settings, AddedModelLoader(catalog, store, settings).load)
        decoders = stack.enter_context(contextlib.closing(DecoderPool(settings)))
        return compute_fit(request, store, models, decoders, settings.batch_photos, report)


ComputeFit = Callable[[FitRequest, Settings, Report, Callable[[], None]], Fitted]


def compute_in_child(
    request: FitRequest, settings: Settings, report: Report, check: Callable[[], None]
) -> Fitted:
    """Compute a fit in a child process; raises as `run_in_child` does."""
    return run_in_child(
        _compute_in_this_process, request, settings, on_progress=report, check=check
    )


class FitWorker:
    """Runs vocabulary fits, PCA fits and reconstructions one after the other."""

    def __init__(
        self,
        context: ExtractorContext,
        name: str,
        on_outcome: Callable[[JobKind, StepOutcome, int], object],
        compute: ComputeFit = compute_in_child,
        wakeups: Wakeups | None = None,
    ) -> None:
        self.context = context
        self._catalog = context.catalog
        self._models = context.models
        self._compute = compute
        self._runner = JobRunner(
            context.catalog, context.settings, name, FIT_WORKER_JOBS, on_outcome, wakeups
        )

    def run(self, stop: threading.Event) -> None:
        """Run jobs until `stop` is set."""
        self._runner.run_jobs(lambda job: self._run(job, stop), stop)

    def run_next(self, stop: threading.Event) -> bool:
        """Run the next job; False when there is none."""
        return self._runner.run_next(lambda job: self._run(job, stop))

    def _run(self, job: Job, stop: threading.Event) -> None:
        self.HANDLERS[job.kind](self, job, stop)

    def _reconstruct(self, job: Job, stop: threading.Event) -> None:
        ReconstructionJob(self.context, job, stop).run()

    def _fit_vocabulary(self, job: Job, stop: threading.Event) -> None:
        extractor = map_extractor(self.context, job)
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
        fitted = self._compute_fit(request, job, stop, len(chosen), len(keys))
        assert isinstance(fitted, VocabularyFile)
        start_generation(
            self.context,
            job,
            DescriptorPipeline(extractor, fitted.centres),
            NewVocabulary(
                VocabularyOrigin.FITTED,
                {**fitted.provenance, "provisional": len(keys) < MIN_PHOTOS_TO_FIT},
            ),
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
        pipeline = self._models.pipeline_of_generation(self._catalog, source)
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
        with self._catalog.read() as session:
            chunks = find_descriptor_rows(session, source.id, chosen)
        located = {photo: (key, row) for key, rows in chunks.items() for row, photo in rows}
        rows = [located[photo] for photo in chosen if photo in located]
        request = PcaFitRequest(rows, source.dimension, components)
        whitening = self._compute_fit(request, job, stop, len(chosen), len(photo_ids))
        assert isinstance(whitening, PcaWhitening)
        projection = PcaProjection(whitening, pipeline.extractor.backbone.device)
        start_generation(
            self.context,
            job,
            replace(pipeline, projection=projection),
            source.vocabulary_id,
            PcaWhiteningFile(whitening, source.spec),
            progress_done=len(chosen) + FIT_PROGRESS_UNITS,
        )

    def _compute_fit(
        self, request: FitRequest, job: Job, stop: threading.Event, sampled: int, photos: int
    ) -> Fitted:
        """Compute a fit; its progress counts the sample, the fit, and the photos to describe."""
        progress = JobProgress(
            self._catalog, job, stop, total=sampled + FIT_PROGRESS_UNITS + photos
        )
        progress.check()

        def report(stage: str, done: int, total: int) -> None:
            if stage in ("sample", "gather"):
                progress.update(min(done, sampled), stage)
            else:
                progress.update(sampled + FIT_PROGRESS_UNITS * done // max(1, total), stage)

        return self._compute(request, self.context.settings, report, progress.check)

    HANDLERS: ClassVar[dict[JobKind, Callable[[FitWorker, Job, threading.Event], None]]] = {
        JobKind.FIT: _fit_vocabulary,
        JobKind.PCA: _fit_whitening,
        JobKind.RECONSTRUCT: _reconstruct,
    }
