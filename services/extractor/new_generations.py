"""The end of a model change's own work: its vocabulary or whitening, and the new generation.

All is stored in one transaction, under the job's lease.
"""

from __future__ import annotations

from typing import Any
from uuid import UUID

from sqlalchemy.orm import Session

from services.extractor.model_registry import (
    DescriptorPipeline,
    ModelRegistry,
    generation_spec_columns,
)
from shared.catalog.database.session import Catalog
from shared.catalog.generations import active_generation
from shared.catalog.maps import Map
from shared.catalog.photos import count_live_photos
from shared.catalog.vocabularies import VocabularyOrigin, add_vocabulary, add_whitening
from shared.descriptors.extractor import Extractor
from shared.descriptors.pca_whitening import PcaWhiteningFile
from shared.descriptors.vocabulary import ClusterCentres, encode_centres
from shared.descriptors.vocabulary_file import Provenance
from shared.jobs import Job
from shared.jobs.leases import get_lease_token, lock_leased_jobs
from shared.jobs.model_changes import create_generation
from shared.storage import ObjectStore
from shared.storage.keys import new_vocabulary_key, new_whitening_key


def map_extractor(catalog: Catalog, models: ModelRegistry, job: Job) -> Extractor:
    """Return the extractor of the job's map with its weights loaded.

    The active generation may have another one that pools instead, until the map has a vocabulary.
    """
    with catalog.read() as session:
        name = session.get_one(Map, job.map_id).extractor
    return models.extractor(name)


def active_extractor(catalog: Catalog, models: ModelRegistry, job: Job) -> Extractor:
    """Return the extractor of the map's active generation, or the map's before there is one."""
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
    """Store a vocabulary and create its generation in one transaction.

    `progress_done` is the progress of the job before any photo is described.
    """
    key = new_vocabulary_key()
    store.put(key, encode_centres(centres))
    with catalog.write() as session:
        for owned in lock_leased_jobs(session, get_lease_token(job), [job]):
            vocabulary = add_vocabulary(
                session,
                job.map_id,
                origin,
                shape=centres.array.shape,
                object_key=key,
                sha256=centres.sha256,
                provenance=provenance,
            )
            _create_generation(
                session, owned, DescriptorPipeline(extractor, centres), vocabulary.id
            )
            _set_describe_progress(session, owned, progress_done, vocabulary_id=str(vocabulary.id))


def start_generation_with_stored_vocabulary(
    catalog: Catalog,
    job: Job,
    pipeline: DescriptorPipeline,
    vocabulary_id: UUID | None,
    whitening_id: UUID | None = None,
) -> None:
    """Create the generation of a stored vocabulary and whitening; None for an extractor without."""
    with catalog.write() as session:
        for owned in lock_leased_jobs(session, get_lease_token(job), [job]):
            _create_generation(session, owned, pipeline, vocabulary_id, whitening_id)
            _set_describe_progress(session, owned, 0)


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
    """Store a PCA whitening, which is `pipeline.projection`, and create its generation.

    As `start_generation_with_new_vocabulary`, in one transaction.
    """
    assert pipeline.projection is not None
    key = new_whitening_key()
    store.put(key, whitening_file.encode())
    with catalog.write() as session:
        for owned in lock_leased_jobs(session, get_lease_token(job), [job]):
            whitening = add_whitening(
                session,
                job.map_id,
                dimension=whitening_file.whitening.dimension,
                components=whitening_file.whitening.components,
                rows=whitening_file.whitening.rows,
                explained=whitening_file.whitening.explained,
                object_key=key,
                sha256=pipeline.projection.sha256,
            )
            _create_generation(session, owned, pipeline, vocabulary_id, whitening.id)
            _set_describe_progress(session, owned, progress_done, whitening_id=str(whitening.id))


def _create_generation(
    session: Session,
    job: Job,
    pipeline: DescriptorPipeline,
    vocabulary_id: UUID | None,
    whitening_id: UUID | None = None,
) -> None:
    columns = generation_spec_columns(session, pipeline, vocabulary_id, whitening_id)
    create_generation(session, job, **columns)


def _set_describe_progress(session: Session, job: Job, progress_done: int, **params: Any) -> None:
    """Extend the job's total progress by the map's live photos, which are still to be described."""
    job.params = {**job.params, **params, "done_before": progress_done}
    job.attempts = 0
    job.progress_done = progress_done
    job.progress_total = progress_done + count_live_photos(session, job.map_id)
