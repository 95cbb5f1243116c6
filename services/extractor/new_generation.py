"""What model changes come to, and how they pause: the transactions under the job's lease."""

from __future__ import annotations

from typing import Any
from uuid import UUID

from services.extractor.loaded import LoadedModels, register, spec_columns
from shared.catalog.generations import active_generation
from shared.catalog.maps import Map
from shared.catalog.photos import count_live
from shared.catalog.session import Catalog
from shared.catalog.vocabularies import VocabularyOrigin, add_vocabulary
from shared.jobs import Job
from shared.jobs.finish import release
from shared.jobs.leases import held
from shared.jobs.model_changes import begin_generation
from shared.objects import ObjectStore
from shared.objects.keys import new_vocabulary_key
from shared.vision.extractors import Extractor
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
) -> None:
    """Store the vocabulary; one transaction makes it known and begins its generation."""
    key = new_vocabulary_key()
    store.put(key, encode_centres(centres))
    with catalog.write() as session:
        for mine in held(session, _token(job), [job]):
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
                **spec_columns(register(session, extractor), extractor, centres, vocabulary.id),
            )
            mine.params = {**mine.params, "vocabulary_id": str(vocabulary.id)}
            mine.attempts = 0
            mine.progress_total = mine.progress_done + count_live(session, job.map_id)


def begin_with_known(
    catalog: Catalog,
    job: Job,
    extractor: Extractor,
    centres: Centres | None,
    vocabulary_id: UUID | None,
) -> None:
    """Begin the generation of a vocabulary that the map has, or of none."""
    with catalog.write() as session:
        for mine in held(session, _token(job), [job]):
            begin_generation(
                session,
                mine,
                **spec_columns(register(session, extractor), extractor, centres, vocabulary_id),
            )
            mine.progress_total = count_live(session, job.map_id)


def go_on(catalog: Catalog, job: Job, **columns: Any) -> None:
    """The slice is done: keep its outcome and let others go first."""
    with catalog.write() as session:
        for mine in held(session, _token(job), [job]):
            for name, value in columns.items():
                setattr(mine, name, value)
            mine.attempts = 0
            release(mine)


def _token(job: Job) -> UUID:
    assert job.lease_token is not None, "a claimed job carries a token"
    return job.lease_token
