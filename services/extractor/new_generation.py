"""What model changes come to, and how they pause: the transactions under the job's lease."""

from __future__ import annotations

from typing import Any
from uuid import UUID

from sqlalchemy.orm import Session

from services.extractor.loaded import (
    DescriptorPipeline,
    ModelRegistry,
    ensure_model_row,
    generation_spec_columns,
)
from shared.catalog.generations import active_generation
from shared.catalog.maps import Map
from shared.catalog.photos import count_live_photos
from shared.catalog.session import Catalog
from shared.catalog.vocabularies import VocabularyOrigin, add_vocabulary
from shared.catalog.whitenings import add_whitening
from shared.jobs import Job
from shared.jobs.finish import release_job
from shared.jobs.leases import get_lease_token, lock_leased_jobs
from shared.jobs.model_changes import create_generation
from shared.objects import ObjectStore
from shared.objects.keys import new_vocabulary_key, new_whitening_key
from shared.vision.extractors import Extractor
from shared.vision.pca_file import PcaWhiteningFile
from shared.vision.provenance import Provenance
from shared.vision.vocabulary import ClusterCentres, encode_centres


def map_extractor(catalog: Catalog, models: ModelRegistry, job: Job) -> Extractor:
    """The extractor of the job's map, its weights loaded."""
    with catalog.read() as session:
        active = active_generation(session, job.map_id)
        name = active.extractor if active else session.get_one(Map, job.map_id).extractor
    return models.extractor(name)


def start_generation_with_new_vocabulary(
    catalog: Catalog,
    store: ObjectStore,
    job: Job,
    extractor: Extractor,
    centres: ClusterCentres,
    origin: VocabularyOrigin,
    provenance: Provenance,
    *,
    progress_done: int = 0,
) -> None:
    """Store the vocabulary; one transaction makes it known and begins its generation.

    `progress_done`: of the job, before anything is described.
    """
    key = new_vocabulary_key()
    store.put(key, encode_centres(centres))
    with catalog.write() as session:
        for mine in lock_leased_jobs(session, get_lease_token(job), [job]):
            vocabulary = add_vocabulary(
                session,
                job.map_id,
                origin,
                shape=centres.array.shape,
                object_key=key,
                sha256=centres.sha256,
                provenance=provenance,
            )
            create_generation(
                session,
                mine,
                **generation_spec_columns(
                    ensure_model_row(session, extractor),
                    DescriptorPipeline(extractor, centres),
                    vocabulary.id,
                ),
            )
            _set_describe_progress(session, mine, progress_done, vocabulary_id=str(vocabulary.id))


def start_generation_with_stored_vocabulary(
    catalog: Catalog,
    job: Job,
    pipeline: DescriptorPipeline,
    vocabulary_id: UUID | None,
    whitening_id: UUID | None = None,
) -> None:
    """Begin the generation of a vocabulary and a whitening that the map has, or of none."""
    with catalog.write() as session:
        for mine in lock_leased_jobs(session, get_lease_token(job), [job]):
            create_generation(
                session,
                mine,
                **generation_spec_columns(
                    ensure_model_row(session, pipeline.extractor),
                    pipeline,
                    vocabulary_id,
                    whitening_id,
                ),
            )
            _set_describe_progress(session, mine, 0)


def start_whitened_generation(
    catalog: Catalog,
    store: ObjectStore,
    job: Job,
    pipeline: DescriptorPipeline,
    whitening_file: PcaWhiteningFile,
    vocabulary_id: UUID | None,
    *,
    progress_done: int,
) -> None:
    """Store the whitening, which `pipeline` carries; one transaction makes it known and begins its
    generation.
    """
    assert pipeline.projection is not None
    key = new_whitening_key()
    store.put(key, whitening_file.encode())
    with catalog.write() as session:
        for mine in lock_leased_jobs(session, get_lease_token(job), [job]):
            whitening = add_whitening(
                session,
                job.map_id,
                dimension=whitening_file.whitening.dimension,
                kept=whitening_file.whitening.kept,
                rows=whitening_file.whitening.rows,
                explained=whitening_file.whitening.explained,
                object_key=key,
                sha256=pipeline.projection.sha256,
            )
            model = ensure_model_row(session, pipeline.extractor)
            create_generation(
                session,
                mine,
                **generation_spec_columns(model, pipeline, vocabulary_id, whitening.id),
            )
            _set_describe_progress(session, mine, progress_done, whitening_id=str(whitening.id))


def _set_describe_progress(session: Session, job: Job, progress_done: int, **params: Any) -> None:
    """What is left to do, beside what has been: every photo."""
    job.params = {**job.params, **params, "done_before": progress_done}
    job.attempts = 0
    job.progress_done = progress_done
    job.progress_total = progress_done + count_live_photos(session, job.map_id)


def checkpoint_and_release(catalog: Catalog, job: Job, **columns: Any) -> None:
    """The slice is done: keep its outcome and let others go first."""
    with catalog.write() as session:
        for mine in lock_leased_jobs(session, get_lease_token(job), [job]):
            for name, value in columns.items():
                setattr(mine, name, value)
            mine.attempts = 0
            release_job(mine)
