"""Model changes, in slices: sample the map's photos, find the centres, begin the generation.

Between two slices everything lies in the object store under `work/<job>/`, so that any worker can
take the next slice, and a query or an upload waits for one slice at most.
"""

from __future__ import annotations

import io
import json
import time
from typing import Any
from uuid import UUID

import numpy as np
import torch
from numpy.typing import NDArray
from sqlalchemy import select

from services.extractor.decoding import DecoderPool
from services.extractor.loaded import LoadedModels, register, spec_columns
from shared.catalog.generations import active_generation
from shared.catalog.maps import Map
from shared.catalog.photos import Photo, PhotoRole, count_live, live_photos
from shared.catalog.session import Catalog
from shared.catalog.vocabularies import VocabularyOrigin, add_vocabulary, get_vocabulary
from shared.errors import Conflict, NotFound, PlacewiseError, Unprocessable
from shared.jobs import Job, JobKind
from shared.jobs.finish import release
from shared.jobs.leases import held
from shared.jobs.model_changes import begin_generation
from shared.objects import ObjectStore
from shared.objects.keys import new_vocabulary_key, work_key
from shared.settings import Settings
from shared.vision.extractors import Extractor
from shared.vision.kmeans import MAX_ITERATIONS, TOLERANCE, iterate, seed_centres
from shared.vision.vocabulary import (
    Centres,
    check_centres,
    decode_centres,
    encode_centres,
)

SLICE_SECONDS = 1.0  # about the time of a batch: what a query may have to wait
PATCHES_PER_CLUSTER = 50  # fewer, and a centre is an accident of the sample
SAMPLE_BYTES = 256_000_000  # of local features that a fit looks at


class ModelChanges:
    """Does one slice of a model change at a time. Holds the features of the fit under way."""

    def __init__(
        self,
        catalog: Catalog,
        store: ObjectStore,
        models: LoadedModels,
        decoders: DecoderPool,
        settings: Settings,
    ) -> None:
        self._catalog = catalog
        self._store = store
        self._models = models
        self._decoders = decoders
        self._settings = settings
        self._points: tuple[UUID, torch.Tensor] | None = None

    def slice(self, job: Job) -> None:
        """The next piece of work of the claimed job; PlacewiseError when it can't go on."""
        if job.kind == JobKind.IMPORT:
            self._import(job)
        elif job.kind == JobKind.SWITCH:
            self._switch(job)
        elif job.stage is None:
            self._plan(job)
        elif job.stage == "sample":
            self._sample(job)
        else:
            self._cluster(job)

    # --- FIT ---------------------------------------------------------------------------------

    def _plan(self, job: Job) -> None:
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
        rng = np.random.default_rng(job.params["seed"])
        size = min(job.params["sample"], len(photo_ids))
        chosen = sorted(rng.choice(len(photo_ids), size=size, replace=False).tolist())
        plan = [str(photo_ids[index]) for index in chosen]
        self._store.put(work_key(job.id, "plan.json"), json.dumps(plan).encode())
        clusters = job.params["clusters"] or self._extractor(job).recipe.clusters
        self._go_on(
            job,
            stage="sample",
            params={**job.params, "clusters": clusters},
            progress_total=len(plan) + len(photo_ids),
        )

    def _sample(self, job: Job) -> None:
        """Local features of the next few photos of the plan, thinned to what a fit can hold."""
        plan = json.loads(self._store.get(work_key(job.id, "plan.json")))
        begin = int(job.params.get("sampled", 0))
        chosen = [UUID(photo_id) for photo_id in plan[begin : begin + self._settings.batch_photos]]
        extractor = self._extractor(job)
        with self._catalog.read() as session:
            live = live_photos(session, chosen)
        photos = []
        for photo_id in chosen:
            if photo_id in live:
                try:
                    photos.append(self._store.get(live[photo_id].object_key))
                except NotFound:
                    continue  # deleted since; a sample does not depend on one photo
        decoded = [
            outcome
            for outcome in self._decoders.decode(photos, extractor.preprocessing)
            if not isinstance(outcome, PlacewiseError)
        ]
        if decoded:
            features = extractor.local_features([photo.pixels for photo in decoded])
            budget = max(1, SAMPLE_BYTES // (4 * extractor.backbone.width * len(plan)))
            generator = torch.Generator().manual_seed(job.params["seed"] + begin)
            points = _thin(features, budget, generator)
            self._put_array(job, f"features-{begin:08d}.npy", points)
        sampled = begin + len(chosen)
        self._go_on(
            job,
            stage="sample" if sampled < len(plan) else "cluster",
            params={**job.params, "sampled": sampled},
            progress_done=sampled,
        )

    def _cluster(self, job: Job) -> None:
        """k-means for about a second; when it has settled, the vocabulary and its generation."""
        points = self._load_points(job)
        clusters = max(1, min(job.params["clusters"], len(points) // PATCHES_PER_CLUSTER))
        done = int(job.params.get("iterations", 0))
        if done == 0:
            centres = seed_centres(points, clusters, job.params["seed"])
        else:
            centres = torch.from_numpy(self._get_array(job, "centres.npy"))
        until = time.monotonic() + SLICE_SECONDS
        while True:  # at least one step, however slow it is
            centres, movement = iterate(points, centres)
            done += 1
            settled = done >= MAX_ITERATIONS or movement <= TOLERANCE
            if settled or time.monotonic() >= until:
                break
        if not settled:
            self._put_array(job, "centres.npy", centres.numpy())
            self._go_on(job, stage="cluster", params={**job.params, "iterations": done})
            return
        fitted = _distinct(centres.numpy())
        extractor = self._extractor(job)
        provenance = {
            **_provenance(extractor),
            "clusters_asked": job.params["clusters"],
            "photos": int(job.params["sampled"]),
            "patches": len(points),
            "seed": job.params["seed"],
            "iterations": done,
        }
        self._begin(job, extractor, check_centres(fitted), VocabularyOrigin.FITTED, provenance)
        self._points = None

    def _load_points(self, job: Job) -> torch.Tensor:
        if self._points is None or self._points[0] != job.id:
            keys = sorted(info.key for info in self._store.list(work_key(job.id, "features-")))
            parts = [np.load(io.BytesIO(self._store.get(key))) for key in keys]
            if not parts:
                raise Unprocessable(
                    "no_photos",
                    "None of the sampled photos could be decoded: nothing to learn from.",
                )
            self._points = (job.id, torch.from_numpy(np.concatenate(parts)))
        return self._points[1]

    # --- IMPORT and SWITCH -------------------------------------------------------------------

    def _import(self, job: Job) -> None:
        extractor = self._extractor(job)
        if not extractor.recipe.needs_vocabulary:
            raise Unprocessable(
                "vocabulary_unfit",
                f"The extractor {extractor.recipe.name} uses no vocabulary.",
            )
        data = self._store.get(job.params["object_key"])
        centres = decode_centres(data, width=extractor.backbone.width)
        provenance = {"imported_from": job.params["filename"], **_provenance(extractor)}
        self._begin(job, extractor, centres, VocabularyOrigin.IMPORTED, provenance)

    def _switch(self, job: Job) -> None:
        extractor = self._extractor(job)
        with self._catalog.read() as session:
            vocabulary = None
            if job.params["vocabulary_id"] is not None:
                vocabulary_id = UUID(job.params["vocabulary_id"])
                vocabulary = get_vocabulary(session, job.map_id, vocabulary_id)
        centres = self._models.centres(vocabulary) if vocabulary else None
        if extractor.recipe.needs_vocabulary == (centres is None):
            raise Unprocessable(
                "vocabulary_unfit",
                f"The extractor {extractor.recipe.name} "
                + ("needs a vocabulary." if centres is None else "uses no vocabulary."),
            )
        if centres is not None and centres.dimension != extractor.backbone.width:
            raise Unprocessable(
                "vocabulary_unfit",
                f"The vocabulary has {centres.dimension} dimensions, the local features of "
                f"{extractor.recipe.name} {extractor.backbone.width}.",
            )
        with self._catalog.write() as session:
            for mine in held(session, _token(job), [job]):
                begin_generation(
                    session,
                    mine,
                    **spec_columns(
                        register(session, extractor),
                        extractor,
                        centres,
                        vocabulary.id if vocabulary else None,
                    ),
                )
                mine.progress_total = count_live(session, job.map_id)

    # --- what they share ---------------------------------------------------------------------

    def _extractor(self, job: Job) -> Extractor:
        with self._catalog.read() as session:
            active = active_generation(session, job.map_id)
            name = active.extractor if active else session.get_one(Map, job.map_id).extractor
        extractor = self._models.extractor(name)
        if job.kind == JobKind.FIT and not extractor.recipe.needs_vocabulary:
            raise Unprocessable(
                "vocabulary_unfit",
                f"The extractor {name} uses no vocabulary: there is nothing to fit.",
            )
        return extractor

    def _begin(
        self,
        job: Job,
        extractor: Extractor,
        centres: Centres,
        origin: VocabularyOrigin,
        provenance: dict[str, Any],
    ) -> None:
        """Store the vocabulary; one transaction makes it known and begins its generation."""
        key = new_vocabulary_key()
        self._store.put(key, encode_centres(centres))
        with self._catalog.write() as session:
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

    def _go_on(self, job: Job, **columns: Any) -> None:
        """The slice is done: keep its outcome and let others go first."""
        with self._catalog.write() as session:
            for mine in held(session, _token(job), [job]):
                for name, value in columns.items():
                    setattr(mine, name, value)
                mine.attempts = 0
                release(mine)

    def _put_array(self, job: Job, name: str, array: NDArray[np.float32]) -> None:
        buffer = io.BytesIO()
        np.save(buffer, array, allow_pickle=False)
        self._store.put(work_key(job.id, name), buffer.getvalue())

    def _get_array(self, job: Job, name: str) -> NDArray[np.float32]:
        array: NDArray[np.float32] = np.load(io.BytesIO(self._store.get(work_key(job.id, name))))
        return array


def _thin(
    features: list[torch.Tensor], budget: int, generator: torch.Generator
) -> NDArray[np.float32]:
    """At most `budget` patches of each photo: (patches, width) of each -> (n, width) of all."""
    kept = [
        one
        if len(one) <= budget
        else one[torch.randperm(len(one), generator=generator)[:budget].sort().values]
        for one in features
    ]
    points: NDArray[np.float32] = torch.cat(kept).numpy()
    # A patch without any structure has a zero feature, which no centre can describe.
    structured: NDArray[np.float32] = points[np.linalg.norm(points, axis=1) > 0]
    return structured


def _distinct(centres: NDArray[np.float32]) -> NDArray[np.float32]:
    """Photos that are all alike can bear fewer centres than asked: keep the distinct ones."""
    distinct: NDArray[np.float32] = np.unique(centres, axis=0)
    usable: NDArray[np.float32] = distinct[np.linalg.norm(distinct, axis=1) > 1e-6]
    return usable


def _provenance(extractor: Extractor) -> dict[str, Any]:
    backbone = extractor.backbone
    return {
        "backbone": backbone.name,
        "backbone_fingerprint": backbone.fingerprint,
        "layer": backbone.layer,
        "facet": backbone.facet,
        "preprocessing": extractor.preprocessing.as_spec(),
    }


def _token(job: Job) -> UUID:
    assert job.lease_token is not None, "a claimed job carries a token"
    return job.lease_token
