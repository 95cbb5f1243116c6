"""Model changes without a fit: vocabulary imports and switches, and imports of checkpoints."""

from __future__ import annotations

from dataclasses import dataclass
from uuid import UUID

from services.extractor.added_models import ModelImporter, model_cache_folder
from services.extractor.model_registry import DescriptorPipeline, ModelRegistry
from services.extractor.new_generations import (
    active_extractor,
    map_extractor,
    start_generation_with_new_vocabulary,
    start_generation_with_stored_vocabulary,
)
from shared.catalog.database.session import Catalog
from shared.catalog.vocabularies import StoredWhitening, VocabularyOrigin, get_vocabulary
from shared.config.settings import Settings
from shared.descriptors.extractor import Extractor
from shared.descriptors.pca_whitening import decode_whitening
from shared.descriptors.vocabulary import ClusterCentres
from shared.descriptors.vocabulary_file import check_vocabulary_fits, decode_vocabulary
from shared.errors import Unprocessable
from shared.jobs import Job, JobKind
from shared.storage import ObjectStore


@dataclass(frozen=True, slots=True)
class _VocabularySwitchJob:
    """Switches a map to an imported or stored vocabulary; one step each."""

    catalog: Catalog
    store: ObjectStore
    models: ModelRegistry

    def import_file(self, job: Job) -> None:
        """Import the vocabulary file at `object_key`.

        Raises:
            Unprocessable: `vocabulary_unusable` if the map's extractor can't use it.
        """
        extractor = map_extractor(self.catalog, self.models, job)
        imported = decode_vocabulary(self.store.get(job.params["object_key"]))
        check_vocabulary_fits(imported.provenance, imported.centres, extractor)
        start_generation_with_new_vocabulary(
            self.catalog,
            self.store,
            job,
            extractor,
            imported.centres,
            VocabularyOrigin.IMPORTED,
            {**imported.provenance, "imported_from": job.params["filename"]},
        )

    def switch_vocabulary(self, job: Job) -> None:
        """Switch to the map's vocabulary `vocabulary_id`, or to None for an extractor without one.

        With the parameter `extractor`, also switch to that extractor; None then means the
        vocabulary that it ships with. Without both, a map that pools until it has a vocabulary
        goes on doing so.

        Raises:
            Unprocessable: `vocabulary_unusable` if the extractor can't use the vocabulary, or if it
                needs one and None was given.
        """
        if job.params.get("extractor") is None:
            current = active_extractor if job.params["vocabulary_id"] is None else map_extractor
            extractor = current(self.catalog, self.models, job)
            shipped = None
        else:
            extractor = self.models.extractor(job.params["extractor"])
            shipped = extractor.shipped_vocabulary()
        if job.params["vocabulary_id"] is None:
            if shipped is not None:
                start_generation_with_new_vocabulary(
                    self.catalog,
                    self.store,
                    job,
                    extractor,
                    shipped[0],
                    VocabularyOrigin.SHIPPED,
                    shipped[1],
                )
                return
            if extractor.config.needs_vocabulary:
                raise Unprocessable(
                    "vocabulary_unusable",
                    f"The extractor {extractor.config.name} needs a vocabulary. Choose one with "
                    "`vocabulary_id`.",
                )
            self._start_generation(job, extractor, None, None)
            return
        with self.catalog.read() as session:
            vocabulary = get_vocabulary(session, job.map_id, UUID(job.params["vocabulary_id"]))
        centres = self.models.centres(vocabulary)
        check_vocabulary_fits(vocabulary.provenance, centres, extractor)
        self._start_generation(job, extractor, centres, vocabulary.id)

    def _start_generation(
        self,
        job: Job,
        extractor: Extractor,
        centres: ClusterCentres | None,
        vocabulary_id: UUID | None,
    ) -> None:
        """Create the generation, with the whitening that the job names, if any.

        A reindexed generation keeps its whitening. Unprocessable (`pca_unusable`) if the whitening
        was fitted on other descriptors.
        """
        whitening_id = job.params.get("whitening_id")
        if whitening_id is None:
            start_generation_with_stored_vocabulary(
                self.catalog, job, DescriptorPipeline(extractor, centres), vocabulary_id
            )
            return
        with self.catalog.read() as session:
            stored = session.get_one(StoredWhitening, UUID(whitening_id))
        whitening_file = decode_whitening(self.store.get(stored.object_key))
        whitening_file.check_compatible(extractor.spec(centres))
        pipeline = DescriptorPipeline(extractor, centres, self.models.projection(stored))
        start_generation_with_stored_vocabulary(
            self.catalog, job, pipeline, vocabulary_id, stored.id
        )


class ModelChangeRunner:
    """Runs model changes that take no longer than a batch; fits have a worker of their own."""

    def __init__(
        self, catalog: Catalog, store: ObjectStore, models: ModelRegistry, settings: Settings
    ) -> None:
        self._switch = _VocabularySwitchJob(catalog, store, models)
        self._add = ModelImporter(catalog, store, model_cache_folder(settings))

    def run(self, job: Job) -> None:
        """Run the claimed job; PlacewiseError if it can't be done."""
        if job.kind == JobKind.ADD_MODEL:
            self._add.import_checkpoint(job)
        elif job.kind == JobKind.IMPORT:
            self._switch.import_file(job)
        else:
            self._switch.switch_vocabulary(job)
