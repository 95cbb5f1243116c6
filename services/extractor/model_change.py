"""Model changes, in slices: each is one short piece of work, so that a query waits for one at most.

    add_model.py         a checkpoint that was sent; no map changes by it
    fit_vocabulary.py    plan, describe a sample, find the centres
    take_vocabulary.py   a file that was brought, or a vocabulary that the map has
    fit_pca.py           gather stored rows, find their directions
    new_generation.py    what all of them come to

Between two slices everything lies in the object store under `work/<job>/`, so that any worker can
take the next one.
"""

from __future__ import annotations

from services.extractor.add_model import AddModel
from services.extractor.added_models import cache_folder
from services.extractor.decoding import DecoderPool
from services.extractor.fit_pca import FitPca
from services.extractor.fit_vocabulary import FitVocabulary
from services.extractor.loaded import LoadedModels
from services.extractor.take_vocabulary import TakeVocabulary
from shared.catalog.session import Catalog
from shared.jobs import Job, JobKind
from shared.objects import ObjectStore
from shared.settings import Settings


class ModelChanges:
    """Does one slice of a model change at a time."""

    def __init__(
        self,
        catalog: Catalog,
        store: ObjectStore,
        models: LoadedModels,
        decoders: DecoderPool,
        settings: Settings,
    ) -> None:
        self._fit = FitVocabulary(catalog, store, models, decoders, settings)
        self._take = TakeVocabulary(catalog, store, models)
        self._pca = FitPca(catalog, store, models)
        self._add = AddModel(catalog, store, cache_folder(settings))

    def slice(self, job: Job) -> None:
        """The next piece of work of the claimed job; PlacewiseError when it can't go on."""
        if job.kind == JobKind.ADD_MODEL:
            self._add.from_checkpoint(job)
        elif job.kind == JobKind.IMPORT:
            self._take.from_file(job)
        elif job.kind == JobKind.SWITCH:
            self._take.of_map(job)
        elif job.kind == JobKind.PCA:
            self._pca.slice(job)
        else:
            self._fit.slice(job)
