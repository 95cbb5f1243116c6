"""Model registry of a worker: LRU caches of loaded extractors, vocabularies and PCA whitenings."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any
from uuid import UUID
from weakref import WeakValueDictionary

import torch
from cachetools import LRUCache
from sqlalchemy.orm import Session

from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation
from shared.catalog.models import Model, get_model_for_loading, get_or_create_model
from shared.catalog.vocabularies import StoredWhitening, Vocabulary
from shared.config.settings import Settings, usable_processors
from shared.descriptors.backbones import Backbone
from shared.descriptors.extractor import Extractor, choose_device, spec_fingerprint
from shared.descriptors.inference import (
    PRECISIONS,
    BatchSizeLimit,
    Precision,
    choose_precision,
    model_fits_gpu,
)
from shared.descriptors.pca_whitening import PcaProjection, decode_whitening
from shared.descriptors.vocabulary import ClusterCentres, decode_centres
from shared.errors import PlacewiseError, Unavailable
from shared.extractor_config.configs import ExtractorConfig
from shared.matching.features import DETECTOR
from shared.matching.xfeat import XFeatDetector, load_detector
from shared.storage import ObjectStore

LoadAddedModel = Callable[[ExtractorConfig, torch.device], Backbone]

MAX_EXTRACTORS = 2  # a large backbone takes gigabytes of GPU memory
MAX_VOCABULARIES = 16
MAX_WHITENINGS = 2  # one from 98,304 to 512 dimensions takes 201 MB of device memory


@dataclass(frozen=True, slots=True)
class DescriptorPipeline:
    """Extractor, vocabulary centres and PCA projection that compute a generation's descriptors."""

    extractor: Extractor
    centres: ClusterCentres | None = None
    projection: PcaProjection | None = None

    @property
    def spec(self) -> dict[str, Any]:
        """The extractor spec of the descriptors."""
        return self.extractor.spec(self.centres, self.projection)


class ModelRegistry:
    """LRU caches of models, shared by the threads that prepare and describe batches."""

    def __init__(
        self,
        store: ObjectStore,
        settings: Settings,
        load_added: LoadAddedModel,
        on_load: Callable[[float], object] = lambda seconds: None,
    ) -> None:
        """Create empty caches.

        `load_added` loads the weights of an added model (`AddedModelLoader.load`). `on_load` is
        called with the seconds that loading an extractor took.
        """
        self._on_load = on_load
        self._store = store
        self._load_added = load_added
        self._settings = settings
        self._lock = threading.RLock()
        self._device = choose_device(settings.device)
        # PyTorch does not know a container's limit, and waits for threads that may not run.
        torch.set_num_threads(min(torch.get_num_threads(), usable_processors()))
        self._extractors: LRUCache[str, Extractor] = LRUCache(MAX_EXTRACTORS)
        # Extractors with the same local features share a backbone.
        self._backbones: WeakValueDictionary[object, Backbone] = WeakValueDictionary()
        # Kept beyond eviction, so that a reloaded model does not run out of memory again.
        self._pass_limits = defaultdict[object, BatchSizeLimit](
            lambda: BatchSizeLimit(self._device)
        )
        self._load_errors: dict[str, PlacewiseError] = {}
        self._update_state()
        self._centres: LRUCache[UUID, ClusterCentres] = LRUCache(MAX_VOCABULARIES)
        self._projections: LRUCache[UUID, PcaProjection] = LRUCache(MAX_WHITENINGS)

    def extractor(self, name: str, precision: Precision | None = None) -> Extractor:
        """Return the extractor called `name` with its weights loaded.

        The precision is that of an existing generation (see `extractor_of_generation`), or by
        default that of new generations, PRECISION.
        """
        config = self._settings.extractor_config(name)
        if precision is None:
            precision = choose_precision(self._settings.precision, config, self._device)
        with self._lock:
            if config.name not in self._extractors:
                with self._report_load(name):
                    self._extractors[config.name] = self._load(config, precision)
            return self._extractors[config.name].with_precision(precision)

    @contextlib.contextmanager
    def _report_load(self, name: str) -> Iterator[None]:
        """Show in `state` whether the model called `name` could be loaded in the block."""
        try:
            with model_fits_gpu(name):
                yield
        except PlacewiseError as error:
            self._load_errors[name] = error
            raise
        else:
            self._load_errors.pop(name, None)
        finally:
            self._update_state()

    def _update_state(self) -> None:
        # Replaced as a whole: heartbeats read it without the lock, which a load holds for minutes.
        self.state: dict[str, Any] = {
            "device": self._device.type,
            "models": sorted(self._extractors),
            "errors": {name: error.code for name, error in self._load_errors.items()},
            "error_details": {name: error.detail for name, error in self._load_errors.items()},
        }

    def extractor_of_generation(self, generation: Generation) -> Extractor:
        """Return the generation's extractor in the precision that the generation was created with.

        PRECISION and the device do not matter: rows of two precisions are never mixed.

        Raises:
            Unavailable: `spec_differs` if this release does not know the precision.
        """
        precision = generation.spec["precision"]
        if precision not in PRECISIONS:
            raise Unavailable(
                "spec_differs",
                f"Generation {generation.id} uses precision {precision}, which this worker does "
                f"not support: it supports {' and '.join(PRECISIONS)}. Upgrade it, or start a "
                "model change (POST /api/v1/generations).",
                generation_id=str(generation.id),
            )
        return self.extractor(generation.extractor, precision)

    def _load(self, config: ExtractorConfig, precision: Precision) -> Extractor:
        limit = self._pass_limits[config.backbone_key]
        shared_backbone = self._backbones.get(config.backbone_key)
        if shared_backbone is not None:
            return Extractor(
                config, self._device, precision=precision, backbone=shared_backbone, limit=limit
            )
        started = time.perf_counter()
        extractor = Extractor(
            config,
            self._device,
            precision=precision,
            dino_weights=self._settings.dino_weights,
            backbone=self._load_added(config, self._device) if config.added_model else None,
            limit=limit,
        )
        self._backbones[config.backbone_key] = extractor.backbone
        if self._device.type == "cuda":
            extractor.warm_up(self._settings.batch_photos)
        self._on_load(time.perf_counter() - started)
        return extractor

    def detector(self) -> XFeatDetector:
        """Return the detector of local features with its weights loaded.

        Raises:
            Misconfigured: as `load_detector`.
        """
        with self._lock, self._report_load(DETECTOR):
            return load_detector(self._device)

    def centres(self, vocabulary: Vocabulary) -> ClusterCentres:
        """Return the vocabulary's centres, verified against the catalog's hash."""
        with self._lock:
            if vocabulary.id not in self._centres:
                centres = decode_centres(self._store.get(vocabulary.object_key))
                if centres.sha256 != vocabulary.sha256:
                    raise _corrupt_error("vocabulary", vocabulary.id, "fit a new one")
                self._centres[vocabulary.id] = centres
            return self._centres[vocabulary.id]

    def projection(self, whitening: StoredWhitening) -> PcaProjection:
        """Return the PCA projection on the device, verified against the catalog's hash."""
        with self._lock:
            if whitening.id not in self._projections:
                stored = decode_whitening(self._store.get(whitening.object_key))
                projection = PcaProjection(stored.whitening, self._device)
                if projection.sha256 != whitening.sha256:
                    raise _corrupt_error("whitening", whitening.id, "start a model change")
                self._projections[whitening.id] = projection
            return self._projections[whitening.id]

    def pipeline_of_generation(
        self, catalog: Catalog, generation: Generation
    ) -> DescriptorPipeline:
        """Return the pipeline of a generation, with its vocabulary and whitening.

        Raises as `extractor_of_generation`, `centres` and `projection` do.
        """
        vocabulary, whitening = None, None
        with catalog.read() as session:
            if generation.vocabulary_id is not None:
                vocabulary = session.get(Vocabulary, generation.vocabulary_id)
            if generation.whitening_id is not None:
                whitening = session.get(StoredWhitening, generation.whitening_id)
        return DescriptorPipeline(
            self.extractor_of_generation(generation),
            self.centres(vocabulary) if vocabulary else None,
            self.projection(whitening) if whitening else None,
        )


def _ensure_model_row(session: Session, extractor: Extractor) -> Model:
    """Return the catalog's row of the extractor's weights, creating it if needed.

    Raises:
        Misconfigured: `model_missing` if an added model has been removed meanwhile.
    """
    backbone = extractor.backbone
    if added := extractor.config.added_model:
        # Locked, because a generation that uses it is created in this transaction.
        return get_model_for_loading(session, added, lock=True)
    return get_or_create_model(
        session, backbone.name, backbone.fingerprint, backbone.licence, backbone.card
    )


def generation_spec_columns(
    session: Session,
    pipeline: DescriptorPipeline,
    vocabulary_id: UUID | None,
    whitening_id: UUID | None = None,
) -> dict[str, object]:
    """Return the columns of a generation row that define how its descriptors are computed.

    Raises:
        Misconfigured: As `_ensure_model_row`.
    """
    spec = pipeline.spec
    return {
        "extractor": pipeline.extractor.config.name,
        "spec": spec,
        "spec_fingerprint": spec_fingerprint(spec),
        "dimension": spec["dimension"],
        "model_id": _ensure_model_row(session, pipeline.extractor).id,
        "vocabulary_id": vocabulary_id,
        "whitening_id": whitening_id,
    }


def check_spec_matches(
    generation: Generation, pipeline: DescriptorPipeline, *, decoder_matters: bool = True
) -> None:
    """Raise Unavailable (`spec_differs`) if this worker can't reproduce the generation's spec."""
    spec = pipeline.spec
    differing = sorted(
        key
        for key in spec.keys() | generation.spec.keys()
        if spec.get(key) != generation.spec.get(key) and (decoder_matters or key != "decoder")
    )
    if not differing:
        return
    raise Unavailable(
        "spec_differs",
        f"This worker computes other descriptors than those of generation {generation.id}: "
        + "; ".join(f"{k} is {spec.get(k)!r}, was {generation.spec.get(k)!r}" for k in differing)
        + ". Start a model change (POST /api/v1/generations), or install the old versions again.",
        generation_id=str(generation.id),
    )


def _corrupt_error(kind: str, id_: UUID, remedy: str) -> Unavailable:
    reason = f"The {kind} {id_} is corrupt: its hash differs"
    return Unavailable(f"{kind}_corrupt", f"{reason}. Restore it from a backup, or {remedy}.")
