"""FIT: learn a vocabulary from the map's own photos, a slice at a time.

    plan      which photos, in which order             -> plan.json
    sample    some patches of the next few of them     -> patches-*.f32
    cluster   steps of `shared.vision.fit`             -> fit.npz

The names are objects under `work/<job>/`. Nothing of a fit is kept in the worker's memory.
"""

from __future__ import annotations

import json
from uuid import UUID

from sqlalchemy import select

from services.extractor.decoding import DecoderPool
from services.extractor.loaded import ModelRegistry
from services.extractor.new_generation import (
    checkpoint_and_release,
    map_extractor,
    start_generation_with_new_vocabulary,
)
from services.extractor.slices import FIT_PROGRESS_UNITS, run_fit_steps
from shared.catalog.photos import Photo, PhotoRole, get_live_photos
from shared.catalog.session import Catalog
from shared.catalog.vocabularies import VocabularyOrigin
from shared.errors import Conflict, NotFound, PlacewiseError, Unprocessable
from shared.jobs import Job
from shared.objects import ObjectStore
from shared.objects.keys import job_work_key
from shared.settings import Settings
from shared.vision.extractors import Extractor
from shared.vision.fit import VocabularyFit
from shared.vision.patches import PatchStore, sample_photos
from shared.vision.provenance import fit_provenance


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
