"""How long a slice of a model change is, and the steps of a fit that make one up.

What model changes come to, and how they pause: the transactions under the job's lease.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any, Protocol
from uuid import UUID

from sqlalchemy.orm import Session

from services.extractor.model_registry import (
    DescriptorPipeline,
    ModelRegistry,
    ensure_model_row,
    generation_spec_columns,
)
from shared.catalog.generations import active_generation
from shared.catalog.maps import Map
from shared.catalog.photos import count_live_photos
from shared.catalog.session import Catalog
from shared.catalog.vocabularies import VocabularyOrigin, add_vocabulary, add_whitening
from shared.descriptors.extractor import Extractor
from shared.descriptors.pca_whitening import PcaWhiteningFile
from shared.descriptors.vocabulary import ClusterCentres, encode_centres
from shared.descriptors.vocabulary_file import Provenance
from shared.jobs import Job
from shared.jobs.leases import get_lease_token, lock_leased_jobs
from shared.jobs.model_changes import create_generation
from shared.jobs.transitions import release_job
from shared.storage import ObjectStore
from shared.storage.keys import job_work_key, new_vocabulary_key, new_whitening_key


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


STEP_SECONDS = 1.0  # about the time of a batch: what a query may have to wait
FIT_PROGRESS_UNITS = 100  # of the job's progress: the steps of its fit, in per cent


class IncrementalFit(Protocol):
    """A fit that is done step by step, and saved between two of them."""

    @property
    def done(self) -> bool: ...

    @property
    def progress(self) -> tuple[int, int]:
        """Steps done, and all of them."""

    def save(self) -> bytes: ...

    def resume(self, data: bytes) -> None: ...


def time_slice() -> Iterator[None]:
    """Once, however slow the first round of the loop is, and again for about a second."""
    until = time.monotonic() + STEP_SECONDS
    while True:
        yield
        if time.monotonic() >= until:
            return


def run_fit_steps(
    catalog: Catalog,
    store: ObjectStore,
    job: Job,
    fit: IncrementalFit,
    step: Callable[[], object],
    *,
    resumed_param: str,
    progress_done: int,
) -> bool:
    """A slice of steps; True when the fit is done.

    Else it is saved and the job goes on. `resumed_param` is the parameter of the job that says
    that there
    is a saved one, `progress_done` the job's progress before the fit.
    """
    saved = job_work_key(job.id, "fit.npz")
    if job.params.get(resumed_param):
        fit.resume(store.get(saved))
    for _ in time_slice():
        if fit.done:
            break
        step()
    if fit.done:
        return True
    store.put(saved, fit.save())
    done, most = fit.progress
    checkpoint_and_release(
        catalog,
        job,
        params={**job.params, resumed_param: True},
        progress_done=progress_done + FIT_PROGRESS_UNITS * done // most,
    )
    return False
