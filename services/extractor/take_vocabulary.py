"""Model changes to centres that are there: in a file that was brought, or in the map already."""

from __future__ import annotations

from uuid import UUID

from services.extractor.loaded import DescriptorPipeline, ModelRegistry
from services.extractor.new_generation import (
    map_extractor,
    start_generation_with_new_vocabulary,
    start_generation_with_stored_vocabulary,
)
from shared.catalog.session import Catalog
from shared.catalog.vocabularies import VocabularyOrigin, get_vocabulary
from shared.catalog.whitenings import StoredWhitening
from shared.errors import Unprocessable
from shared.jobs import Job
from shared.objects import ObjectStore
from shared.vision.extractors import Extractor
from shared.vision.pca_file import decode_whitening
from shared.vision.provenance import check_vocabulary_fits
from shared.vision.vocabulary import ClusterCentres
from shared.vision.vocabulary_file import decode_vocabulary


class VocabularySwitchJob:
    """One slice each: nothing is calculated."""

    def __init__(self, catalog: Catalog, store: ObjectStore, models: ModelRegistry) -> None:
        self._catalog = catalog
        self._store = store
        self._models = models

    def import_file(self, job: Job) -> None:
        """IMPORT: the vocabulary in the file under `object_key`; Unprocessable
        (`vocabulary_unfit`) when the map's extractor can't use it.
        """
        extractor = map_extractor(self._catalog, self._models, job)
        brought = decode_vocabulary(self._store.get(job.params["object_key"]))
        check_vocabulary_fits(brought.provenance, brought.centres, extractor)
        start_generation_with_new_vocabulary(
            self._catalog,
            self._store,
            job,
            extractor,
            brought.centres,
            VocabularyOrigin.IMPORTED,
            {**brought.provenance, "imported_from": job.params["filename"]},
        )

    def switch_vocabulary(self, job: Job) -> None:
        """SWITCH: the vocabulary `vocabulary_id` of the map, or None for extractors without one;
        with `extractor` to that one, where None takes the vocabulary that comes with it.
        """
        if job.params.get("extractor") is None:
            extractor = map_extractor(self._catalog, self._models, job)
            shipped = None
        else:
            extractor = self._models.extractor(job.params["extractor"])
            shipped = extractor.shipped_vocabulary()
        if job.params["vocabulary_id"] is None:
            if shipped is not None:
                start_generation_with_new_vocabulary(
                    self._catalog,
                    self._store,
                    job,
                    extractor,
                    shipped[0],
                    VocabularyOrigin.SHIPPED,
                    shipped[1],
                )
                return
            if extractor.recipe.needs_vocabulary:
                raise Unprocessable(
                    "vocabulary_unfit",
                    f"The extractor {extractor.recipe.name} needs a vocabulary.",
                )
            self._start_generation(job, extractor, None, None)
            return
        with self._catalog.read() as session:
            vocabulary = get_vocabulary(session, job.map_id, UUID(job.params["vocabulary_id"]))
        centres = self._models.centres(vocabulary)
        check_vocabulary_fits(vocabulary.provenance, centres, extractor)
        self._start_generation(job, extractor, centres, vocabulary.id)

    def _start_generation(
        self,
        job: Job,
        extractor: Extractor,
        centres: ClusterCentres | None,
        vocabulary_id: UUID | None,
    ) -> None:
        """The generation, with the whitening that the job names, if any: a renewed generation keeps
        its own. Unprocessable (`pca_unfit`) when the descriptors have become others.
        """
        whitening_id = job.params.get("whitening_id")
        if whitening_id is None:
            start_generation_with_stored_vocabulary(
                self._catalog, job, DescriptorPipeline(extractor, centres), vocabulary_id
            )
            return
        with self._catalog.read() as session:
            stored = session.get_one(StoredWhitening, UUID(whitening_id))
        kept = decode_whitening(self._store.get(stored.object_key))
        kept.check_compatible(extractor.spec(centres))
        made = DescriptorPipeline(extractor, centres, self._models.projection(stored))
        start_generation_with_stored_vocabulary(self._catalog, job, made, vocabulary_id, stored.id)
