"""PCA fit: fits a whitening on the map's stored descriptor rows, without describing photos.

The stages, with their objects under `work/<job>/`:

    plan      choose the photos whose rows are read, and the column blocks  -> plan.json
    gather    copy the next of these rows                                    -> rows-*.f32
    reduce    run steps of `shared.descriptors.pca_fit`            -> fit.npz, part-*.npz

No state is kept in the worker's memory. The longest step computes the variances of the sample: some
seconds for 2,000 rows.
"""

from __future__ import annotations

import io
import json
from dataclasses import dataclass
from uuid import UUID

import numpy as np
from sqlalchemy import select

from services.extractor.checkpointed_steps import (
    FIT_PROGRESS_UNITS,
    checkpoint_and_release,
    run_fit_steps,
    start_whitened_generation,
    time_slice,
)
from services.extractor.model_registry import DescriptorPipeline, ModelRegistry
from services.extractor.prepare import read_stored_rows
from shared.catalog.chunks import Descriptor
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation
from shared.catalog.photos import Photo, PhotoRole
from shared.catalog.vocabularies import Vocabulary, get_pca_source_generation
from shared.descriptors.pca_fit import (
    PcaBlock,
    PcaFit,
    StoredColumns,
    block_count,
    block_width,
    check_pca_fittable,
    sample_rows,
    sample_size,
    usable_rows,
)
from shared.descriptors.pca_whitening import PcaProjection, PcaWhiteningFile
from shared.errors import Conflict
from shared.jobs import Job
from shared.storage import ObjectStore
from shared.storage.keys import job_work_key

READ_BATCH_BYTES = 16_000_000  # of descriptor rows read at once
SEED = 0


@dataclass(frozen=True, slots=True)
class PcaFitJob:
    """Fits a PCA whitening, one step at a time."""

    catalog: Catalog
    store: ObjectStore
    models: ModelRegistry

    def run_step(self, job: Job) -> None:
        """Run the next step of the job's stage; PlacewiseError if it can't continue."""
        if job.stage is None:
            self._plan(job)
        elif job.stage == "gather":
            self._gather(job)
        else:
            self._reduce(job)

    def _plan(self, job: Job) -> None:
        """Choose the rows to fit on: those of database photos, never of queries."""
        with self.catalog.read() as session:
            source = get_pca_source_generation(session, job.map_id)
            photo_ids = session.scalars(
                select(Descriptor.photo_id)
                .join(Photo, Photo.id == Descriptor.photo_id)
                .where(
                    Descriptor.generation_id == source.id,
                    Photo.deleted_at.is_(None),
                    Photo.role == PhotoRole.DATABASE,
                )
                .order_by(Descriptor.photo_id)
            ).all()
        self._check_spec_unchanged(source)
        dimension = job.params["pca"]
        check_pca_fittable(len(photo_ids), source.dimension, dimension)
        chosen = sample_rows(len(photo_ids), sample_size(source.dimension, dimension), SEED)
        plan = [str(photo_ids[index]) for index in chosen]
        self.store.put(job_work_key(job.id, "plan.json"), json.dumps(plan).encode())
        checkpoint_and_release(
            self.catalog,
            job,
            stage="gather",
            params={
                **job.params,
                "source": str(source.id),
                "dimension": source.dimension,
                "width": block_width(len(plan), source.dimension),
                "looked_at": 0,
                "rows": 0,
            },
            progress_total=len(plan) + FIT_PROGRESS_UNITS + len(photo_ids),
        )

    def _check_spec_unchanged(self, source: Generation) -> None:
        """Conflict (`spec_differs`) if this worker computes other descriptors than the stored ones.

        The projection of stored rows would then not fit new ones.
        """
        pipeline = self._source_pipeline(source)
        if pipeline.spec != source.spec:
            raise Conflict(
                "spec_differs",
                "The map's photos were described by another release than this worker's. Reindex "
                "them first (POST /api/v1/generations with the vocabulary alone).",
                generation_id=str(source.id),
            )

    def _source_pipeline(self, source: Generation) -> DescriptorPipeline:
        vocabulary = None
        if source.vocabulary_id is not None:
            with self.catalog.read() as session:
                vocabulary = session.get_one(Vocabulary, source.vocabulary_id)
        return self.models.pipeline_of_generation(source, vocabulary, None)

    def _gather(self, job: Job) -> None:
        """Copy the next rows of the plan, for about a second."""
        params = job.params
        plan = json.loads(self.store.get(job_work_key(job.id, "plan.json")))
        batch_rows = max(1, READ_BATCH_BYTES // (4 * params["dimension"]))
        sample = self._gathered_rows(job)
        position = params["looked_at"]
        for _ in time_slice():
            if position >= len(plan):
                break
            photo_ids = [UUID(photo_id) for photo_id in plan[position : position + batch_rows]]
            stored = read_stored_rows(self.catalog, self.store, UUID(params["source"]), photo_ids)
            if stored:
                rows = np.stack([stored[photo_id] for photo_id in photo_ids if photo_id in stored])
                sample.add(rows[usable_rows(rows)])
            position += len(photo_ids)
        checkpoint_and_release(
            self.catalog,
            job,
            stage="gather" if position < len(plan) else "reduce",
            params={**params, "looked_at": position, "rows": sample.count},
            progress_done=position,
        )

    def _reduce(self, job: Job) -> None:
        """Run steps of the fit; when it is finished, create the whitening and its generation."""
        params = job.params
        sample = self._gathered_rows(job)
        fit = PcaFit(sample, params["pca"])

        def step() -> None:
            part = fit.step()
            if part is not None:
                self._write_part(job, fit.parts - 1, part)

        if not run_fit_steps(
            self.catalog,
            self.store,
            job,
            fit,
            step,
            resumed_param="reducing",
            progress_done=params["looked_at"],
        ):
            return
        with self.catalog.read() as session:
            source = session.get_one(Generation, UUID(params["source"]))
        whitening = fit.whitening(
            [self._read_part(job, number) for number in range(block_count(sample))]
        )
        pipeline = self._source_pipeline(source)
        projection = PcaProjection(whitening, pipeline.extractor.backbone.device)
        start_whitened_generation(
            self.catalog,
            self.store,
            job,
            DescriptorPipeline(pipeline.extractor, pipeline.centres, projection),
            PcaWhiteningFile(whitening, source.spec),
            source.vocabulary_id,
            progress_done=params["looked_at"] + FIT_PROGRESS_UNITS,
        )

    def _gathered_rows(self, job: Job) -> StoredColumns:
        prefix, params = job_work_key(job.id, "rows-"), job.params
        shape = (params["dimension"], params["width"], params["rows"])
        return StoredColumns(self.store, prefix, *shape)

    def _write_part(self, job: Job, number: int, part: PcaBlock) -> None:
        buffer = io.BytesIO()
        np.savez(buffer, allow_pickle=False, mean=part.mean, directions=part.directions)
        self.store.put(job_work_key(job.id, f"part-{number:05d}.npz"), buffer.getvalue())

    def _read_part(self, job: Job, number: int) -> PcaBlock:
        data = self.store.get(job_work_key(job.id, f"part-{number:05d}.npz"))
        with np.load(io.BytesIO(data), allow_pickle=False) as saved:
            return PcaBlock(saved["mean"], saved["directions"])
