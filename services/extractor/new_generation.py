"""What model changes come to, and how they pause: the transactions under the job's lease."""

from __future__ import annotations

from typing import Any
from uuid import UUID

from sqlalchemy.orm import Session

from services.extractor.loaded import LoadedModels, Made, register, spec_columns
from shared.catalog.generations import active_generation
from shared.catalog.maps import Map
from shared.catalog.photos import count_live
from shared.catalog.session import Catalog
from shared.catalog.vocabularies import VocabularyOrigin, add_vocabulary
from shared.catalog.whitenings import add_whitening
from shared.jobs import Job
from shared.jobs.finish import release
from shared.jobs.leases import held, token_of
from shared.jobs.model_changes import begin_generation
from shared.objects import ObjectStore
from shared.objects.keys import new_vocabulary_key, new_whitening_key
from shared.vision.extractors import Extractor
from shared.vision.pca_file import WhiteningFile
from shared.vision.provenance import Provenance
from shared.vision.vocabulary import Centres, encode_centres


def extractor_of(catalog: Catalog, models: LoadedModels, job: Job) -> Extractor:
    """The extractor of the job's map, its weights loaded."""
    with catalog.read() as session:
        active = active_generation(session, job.map_id)
        name = active.extractor if active else session.get_one(Map, job.map_id).extractor
    return models.extractor(name)


def begin_with_new(
    catalog: Catalog,
    store: ObjectStore,
    job: Job,
    extractor: Extractor,
    centres: Centres,
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
        for mine in held(session, token_of(job), [job]):
            vocabulary = add_vocabulary(
                session,
                job.map_id,
                origin,
                shape=centres.array.shape,
                object_key=key,
                sha256=centres.sha256,
                provenance=provenance,
            )
            begin_generation(
                session,
                mine,
                **spec_columns(
                    register(session, extractor), Made(extractor, centres), vocabulary.id
                ),
            )
            _describe_all(session, mine, progress_done, vocabulary_id=str(vocabulary.id))


def begin_with_known(
    catalog: Catalog,
    job: Job,
    made: Made,
    vocabulary_id: UUID | None,
    whitening_id: UUID | None = None,
) -> None:
    """Begin the generation of a vocabulary and a whitening that the map has, or of none."""
    with catalog.write() as session:
        for mine in held(session, token_of(job), [job]):
            begin_generation(
                session,
                mine,
                **spec_columns(
                    register(session, made.extractor), made, vocabulary_id, whitening_id
                ),
            )
            _describe_all(session, mine, 0)


def begin_whitened(
    catalog: Catalog,
    store: ObjectStore,
    job: Job,
    made: Made,
    found: WhiteningFile,
    vocabulary_id: UUID | None,
    *,
    progress_done: int,
) -> None:
    """Store the whitening, which `made` carries; one transaction makes it known and begins its
    generation.
    """
    assert made.projection is not None
    key = new_whitening_key()
    store.put(key, found.encode())
    with catalog.write() as session:
        for mine in held(session, token_of(job), [job]):
            whitening = add_whitening(
                session,
                job.map_id,
                dimension=found.whitening.dimension,
                kept=found.whitening.kept,
                rows=found.whitening.rows,
                explained=found.whitening.explained,
                object_key=key,
                sha256=made.projection.sha256,
            )
            model = register(session, made.extractor)
            begin_generation(
                session, mine, **spec_columns(model, made, vocabulary_id, whitening.id)
            )
            _describe_all(session, mine, progress_done, whitening_id=str(whitening.id))


def _describe_all(session: Session, job: Job, progress_done: int, **params: Any) -> None:
    """What is left to do, beside what has been: every photo."""
    job.params = {**job.params, **params, "done_before": progress_done}
    job.attempts = 0
    job.progress_done = progress_done
    job.progress_total = progress_done + count_live(session, job.map_id)


def go_on(catalog: Catalog, job: Job, **columns: Any) -> None:
    """The slice is done: keep its outcome and let others go first."""
    with catalog.write() as session:
        for mine in held(session, token_of(job), [job]):
            for name, value in columns.items():
                setattr(mine, name, value)
            mine.attempts = 0
            release(mine)
