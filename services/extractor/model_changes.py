"""Model changes: vocabulary fits, vocabulary imports and switches, PCA fits, checkpoint imports.

`ModelChangeRunner` runs one short step of a model change at a time, so that a query waits for one
step at most. Between steps the state lies in the object store under `work/<job>/`, never in the
worker's memory, so that any worker can run the next step.

A vocabulary fit (`VocabularyFitJob`) has three stages, with these objects under `work/<job>/`:

    plan      choose the photos and their order                              -> plan.json
    sample    sample patches of the next photos                              -> patches-*.f32
    cluster   run steps of `shared.descriptors.vocabulary_fit`               -> fit.npz
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from uuid import UUID

from sqlalchemy import select

from services.extractor.added_models import ModelImporter, model_cache_folder
from services.extractor.checkpointed_steps import (
    FIT_PROGRESS_UNITS,
    active_extractor,
    checkpoint_and_release,
    map_extractor,
    run_fit_steps,
    start_generation_with_new_vocabulary,
    start_generation_with_stored_vocabulary,
)
from services.extractor.decoder_pool import DecoderPool
from services.extractor.fit_pca import PcaFitJob
from services.extractor.model_registry import DescriptorPipeline, ModelRegistry
from shared.catalog.database.session import Catalog
from shared.catalog.photos import Photo, PhotoRole, get_live_photos
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
from shared.extractor_config.configs import MIN_PHOTOS_TO_FIT
from shared.jobs import Job, JobKind
from shared.storage import ObjectStore
from shared.storage.keys import job_work_key


@dataclass(frozen=True, slots=True)
class VocabularyFitJob:
    """Fits a vocabulary on the map's own photos, one step at a time."""

    catalog: Catalog
    store: ObjectStore
    models: ModelRegistry
    decoders: DecoderPool
    settings: Settings

    def run_step(self, job: Job) -> None:
        """Run the next step of the job's stage; PlacewiseError if it can't continue."""
        extractor = map_extractor(self.catalog, self.models, job)
        if not extractor.config.needs_vocabulary:
            raise Unprocessable(
                "vocabulary_unfit",
                f"The extractor {extractor.config.name} uses no vocabulary: "
                "there is nothing to fit.",
            )
        if job.stage is None:
            self._plan(job, extractor)
        elif job.stage == "sample":
            self._sample(job, extractor)
        else:
            self._cluster(job, extractor)

    def _plan(self, job: Job, extractor: Extractor) -> None:
        """Choose the photos to sample, reproducibly from the seed and the photos' ids."""
        with self.catalog.read() as session:
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
                "The map has no photos to fit a vocabulary on. Upload photos first.",
            )
        chosen = sample_photos(
            len(photo_ids), job.params["sample"], extractor.backbone.width, job.params["seed"]
        )
        plan = [str(photo_ids[number]) for number in chosen]
        self.store.put(job_work_key(job.id, "plan.json"), json.dumps(plan).encode())
        clusters = job.params["clusters"] or extractor.config.clusters
        checkpoint_and_release(
            self.catalog,
            job,
            stage="sample",
            params={
                **job.params,
                "clusters": clusters,
                "sampled": 0,
                "described": 0,
                "provisional": len(photo_ids) < MIN_PHOTOS_TO_FIT,
            },
            progress_total=len(plan) + FIT_PROGRESS_UNITS + len(photo_ids),
        )

    def _sample(self, job: Job, extractor: Extractor) -> None:
        """Sample patches of the next photos of the plan."""
        plan = json.loads(self.store.get(job_work_key(job.id, "plan.json")))
        start = job.params["sampled"]
        photo_ids = [
            UUID(photo_id) for photo_id in plan[start : start + self.settings.batch_photos]
        ]
        decoded = [
            outcome
            for outcome in self.decoders.decode(
                self._read_photos(photo_ids), extractor.preprocessing
            )
            if not isinstance(outcome, PlacewiseError)
        ]
        if decoded:
            features = extractor.local_features([photo.pixels for photo in decoded])
            self._patch_store(job, extractor).add(features, start, len(plan), job.params["seed"])
        sampled = start + len(photo_ids)
        checkpoint_and_release(
            self.catalog,
            job,
            stage="sample" if sampled < len(plan) else "cluster",
            params={
                **job.params,
                "sampled": sampled,
                "described": job.params["described"] + len(decoded),
            },
            progress_done=sampled,
        )

    def _read_photos(self, photo_ids: list[UUID]) -> Iterator[bytes]:
        """Yield the bytes of the photos that have not been deleted since the plan."""
        with self.catalog.read() as session:
            live = get_live_photos(session, photo_ids)
        for photo_id in photo_ids:
            if photo_id in live:
                with contextlib.suppress(NotFound):
                    yield self.store.get(live[photo_id].object_key)

    def _cluster(self, job: Job, extractor: Extractor) -> None:
        """Run steps of the fit; when it is finished, create the vocabulary and its generation."""
        params = job.params
        patches = self._patch_store(job, extractor).open()
        fit = VocabularyFit(patches, params["clusters"], params["seed"])
        if not run_fit_steps(
            self.catalog,
            self.store,
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
        provenance["provisional"] = params["provisional"]
        start_generation_with_new_vocabulary(
            self.catalog,
            self.store,
            job,
            extractor,
            centres,
            VocabularyOrigin.FITTED,
            provenance,
            progress_done=params["sampled"] + FIT_PROGRESS_UNITS,
        )

    def _patch_store(self, job: Job, extractor: Extractor) -> PatchStore:
        return PatchStore(self.store, job_work_key(job.id, "patches-"), extractor.backbone.width)


@dataclass(frozen=True, slots=True)
class _VocabularySwitchJob:
    """Switches a map to an imported or stored vocabulary; one step each."""

    catalog: Catalog
    store: ObjectStore
    models: ModelRegistry

    def import_file(self, job: Job) -> None:
        """Import the vocabulary file at `object_key`.

        Raises:
            Unprocessable: `vocabulary_unfit` if the map's extractor can't use it.
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
            Unprocessable: `vocabulary_unfit` if the extractor can't use the vocabulary, or if it
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
                    "vocabulary_unfit",
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

        A reindexed generation keeps its whitening. Unprocessable (`pca_unfit`) if the whitening was
        fitted on other descriptors.
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
    """Runs one step of a model change at a time."""

    def __init__(
        self,
        catalog: Catalog,
        store: ObjectStore,
        models: ModelRegistry,
        decoders: DecoderPool,
        settings: Settings,
    ) -> None:
        self._fit = VocabularyFitJob(catalog, store, models, decoders, settings)
        self._switch = _VocabularySwitchJob(catalog, store, models)
        self._pca = PcaFitJob(catalog, store, models)
        self._add = ModelImporter(catalog, store, model_cache_folder(settings))

    def run_step(self, job: Job) -> None:
        """Run the next step of the claimed job; PlacewiseError if it can't continue."""
        if job.kind == JobKind.ADD_MODEL:
            self._add.import_checkpoint(job)
        elif job.kind == JobKind.IMPORT:
            self._switch.import_file(job)
        elif job.kind == JobKind.SWITCH:
            self._switch.switch_vocabulary(job)
        elif job.kind == JobKind.PCA:
            self._pca.run_step(job)
        else:
            self._fit.run_step(job)
