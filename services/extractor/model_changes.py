"""Model changes, in slices: each is one short piece of work, so that a query waits for one at most.

    add_model.py         a checkpoint that was sent; no map changes by it
    fit_vocabulary.py    plan, describe a sample, find the centres
    take_vocabulary.py   a file that was brought, or a vocabulary that the map has
    fit_pca.py           gather stored rows, find their directions
    slices.py            how long they are, and the steps of a fit
    new_generation.py    what all of them come to

Between two slices everything lies in the object store under `work/<job>/`, so that any worker can
take the next one.

FIT: learn a vocabulary from the map's own photos, a slice at a time.

    plan      which photos, in which order             -> plan.json
    sample    some patches of the next few of them     -> patches-*.f32
    cluster   steps of `shared.descriptors.vocabulary_fit`             -> fit.npz

The names are objects under `work/<job>/`. Nothing of a fit is kept in the worker's memory.

Model changes to centres that are there: in a file that was brought, or in the map already.
"""

from __future__ import annotations

import json
from uuid import UUID

from sqlalchemy import select

from services.extractor.added_models import ModelImporter, model_cache_folder
from services.extractor.checkpointed_steps import (
    FIT_PROGRESS_UNITS,
    checkpoint_and_release,
    map_extractor,
    run_fit_steps,
    start_generation_with_new_vocabulary,
    start_generation_with_stored_vocabulary,
)
from services.extractor.decoder_pool import DecoderPool
from services.extractor.fit_pca import PcaFitJob
from services.extractor.model_registry import DescriptorPipeline, ModelRegistry
from shared.catalog.photos import Photo, PhotoRole, get_live_photos
from shared.catalog.session import Catalog
from shared.catalog.vocabularies import StoredWhitening, VocabularyOrigin, get_vocabulary
from shared.config.settings import Settings
from shared.descriptors.extractor import Extractor
from shared.descriptors.patches import PatchStore, sample_photos
from shared.descriptors.pca_whitening import decode_whitening
from shared.descriptors.vocabulary import ClusterCentres
from shared.descriptors.vocabulary_file import (
    check_vocabulary_fits,
    decode_vocabulary,
    fit_provenance,
)
from shared.descriptors.vocabulary_fit import VocabularyFit
from shared.errors import Conflict, NotFound, PlacewiseError, Unprocessable
from shared.jobs import Job, JobKind
from shared.storage import ObjectStore
from shared.storage.keys import job_work_key


class VocabularyFitJob:
    """Does one slice of a fit at a time."""

    def __init__(
        self,
        catalog: Catalog,
        store: ObjectStore,
        models: ModelRegistry,
        decoders: DecoderPool,
        settings: Settings,
    ) -> None:
        self._catalog = catalog
        self._store = store
        self._models = models
        self._decoders = decoders
        self._settings = settings

    def run_step(self, job: Job) -> None:
        """The next slice, by the job's stage; PlacewiseError when it can't go on."""
        extractor = map_extractor(self._catalog, self._models, job)
        if not extractor.recipe.needs_vocabulary:
            raise Unprocessable(
                "vocabulary_unfit",
                f"The extractor {extractor.recipe.name} uses no vocabulary: "
                "there is nothing to fit.",
            )
        if job.stage is None:
            self._plan(job, extractor)
        elif job.stage == "sample":
            self._sample(job, extractor)
        else:
            self._cluster(job, extractor)

    def _plan(self, job: Job, extractor: Extractor) -> None:
        """Choose the photos to learn from: reproducible from the seed and the photos' ids."""
        with self._catalog.read() as session:
            photo_ids = session.scalars(
                select(Photo.id)
                .where(
                    Photo.map_id == job.map_id,
                    Photo.deleted_at.is_(None),
                    Photo.role == PhotoRole.DATABASE,
                )
                .order_by(Photo.id)
            ).all()
        if not photo_ids:
            raise Conflict(
                "no_photos",
                "The map has no photos to learn a vocabulary from. Upload some first.",
            )
        chosen = sample_photos(
            len(photo_ids), job.params["sample"], extractor.backbone.width, job.params["seed"]
        )
        plan = [str(photo_ids[number]) for number in chosen]
        self._store.put(job_work_key(job.id, "plan.json"), json.dumps(plan).encode())
        clusters = job.params["clusters"] or extractor.recipe.clusters
        checkpoint_and_release(
            self._catalog,
            job,
            stage="sample",
            params={**job.params, "clusters": clusters, "sampled": 0, "described": 0},
            progress_total=len(plan) + FIT_PROGRESS_UNITS + len(photo_ids),
        )

    def _sample(self, job: Job, extractor: Extractor) -> None:
        """Patches of the next few photos of the plan."""
        plan = json.loads(self._store.get(job_work_key(job.id, "plan.json")))
        begin = job.params["sampled"]
        chosen = [UUID(photo_id) for photo_id in plan[begin : begin + self._settings.batch_photos]]
        decoded = [
            outcome
            for outcome in self._decoders.decode(self._read_photos(chosen), extractor.preprocessing)
            if not isinstance(outcome, PlacewiseError)
        ]
        if decoded:
            features = extractor.local_features([photo.pixels for photo in decoded])
            self._patch_store(job, extractor).add(features, begin, len(plan), job.params["seed"])
        sampled = begin + len(chosen)
        checkpoint_and_release(
            self._catalog,
            job,
            stage="sample" if sampled < len(plan) else "cluster",
            params={
                **job.params,
                "sampled": sampled,
                "described": job.params["described"] + len(decoded),
            },
            progress_done=sampled,
        )

    def _read_photos(self, photo_ids: list[UUID]) -> list[bytes]:
        """The photos that are there: a sample does not depend on those deleted since."""
        with self._catalog.read() as session:
            live = get_live_photos(session, photo_ids)
        photos = []
        for photo_id in photo_ids:
            if photo_id in live:
                try:
                    photos.append(self._store.get(live[photo_id].object_key))
                except NotFound:
                    continue
        return photos

    def _cluster(self, job: Job, extractor: Extractor) -> None:
        """Steps for about a second; when they are done, the vocabulary and its generation."""
        params = job.params
        patches = self._patch_store(job, extractor).open()
        fit = VocabularyFit(patches, params["clusters"], params["seed"])
        if not run_fit_steps(
            self._catalog,
            self._store,
            job,
            fit,
            fit.step,
            resumed_param="clustering",
            progress_done=params["sampled"],
        ):
            return
        centres = fit.centres()
        provenance = fit_provenance(
            extractor,
            centres,
            fit,
            requested_clusters=params["clusters"],
            photos=params["described"],
            seed=params["seed"],
        )
        start_generation_with_new_vocabulary(
            self._catalog,
            self._store,
            job,
            extractor,
            centres,
            VocabularyOrigin.FITTED,
            provenance,
            progress_done=params["sampled"] + FIT_PROGRESS_UNITS,
        )

    def _patch_store(self, job: Job, extractor: Extractor) -> PatchStore:
        return PatchStore(self._store, job_work_key(job.id, "patches-"), extractor.backbone.width)


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
