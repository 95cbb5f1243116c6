"""Model changes, in slices: each is one short piece of work, so that a query waits for one at most.

    add_model.py         a checkpoint that was sent; no map changes by it
    fit_vocabulary.py    plan, describe a sample, find the centres
    take_vocabulary.py   a file that was brought, or a vocabulary that the map has
    fit_pca.py           gather stored rows, find their directions
    slices.py            how long they are, and the steps of a fit
    new_generation.py    what all of them come to

Between two slices everything lies in the object store under `work/<job>/`, so that any worker can
take the next one.
"""

from __future__ import annotations

from services.extractor.add_model import ModelImporter
from services.extractor.added_models import model_cache_folder
from services.extractor.decoding import DecoderPool
from services.extractor.fit_pca import PcaFitJob
from services.extractor.fit_vocabulary import VocabularyFitJob
from services.extractor.loaded import ModelRegistry
from services.extractor.take_vocabulary import VocabularySwitchJob
from shared.catalog.session import Catalog
from shared.jobs import Job, JobKind
from shared.objects import ObjectStore
from shared.settings import Settings


class ModelChangeRunner:
    """Does one slice of a model change at a time."""

    def __init__(
        self,
        catalog: Catalog,
        store: ObjectStore,
        models: ModelRegistry,
        decoders: DecoderPool,
        settings: Settings,
    ) -> None:
        self._fit = VocabularyFitJob(catalog, store, models, decoders, settings)
        self._take = VocabularySwitchJob(catalog, store, models)
        self._pca = PcaFitJob(catalog, store, models)
        self._add = ModelImporter(catalog, store, model_cache_folder(settings))

    def run_step(self, job: Job) -> None:
        """The next piece of work of the claimed job; PlacewiseError when it can't go on."""
        if job.kind == JobKind.ADD_MODEL:
            self._add.import_checkpoint(job)
        elif job.kind == JobKind.IMPORT:
            self._take.import_file(job)
        elif job.kind == JobKind.SWITCH:
            self._take.switch_vocabulary(job)
        elif job.kind == JobKind.PCA:
            self._pca.run_step(job)
        else:
            self._fit.run_step(job)
