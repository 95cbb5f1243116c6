"""What the worker keeps in memory: a few loaded extractors, vocabularies and whitenings.

A few values that are costly to make: those used last.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict, defaultdict
from collections.abc import Callable, Hashable, ValuesView
from dataclasses import dataclass
from typing import Any, Generic, TypeVar
from uuid import UUID

import torch
from sqlalchemy.orm import Session

from shared.catalog.generations import Generation
from shared.catalog.models import Model, get_model_for_loading, get_or_create_model
from shared.catalog.vocabularies import StoredWhitening, Vocabulary
from shared.config.settings import Settings
from shared.descriptors.backbones import Backbone
from shared.descriptors.extractor import Extractor, choose_device, spec_fingerprint
from shared.descriptors.inference import PRECISIONS, BatchSizeLimit, Precision, choose_precision
from shared.descriptors.pca_whitening import PcaProjection, decode_whitening
from shared.descriptors.vocabulary import ClusterCentres, decode_centres
from shared.errors import Unavailable
from shared.extractor_config.configs import ExtractorConfig
from shared.storage import ObjectStore

Key = TypeVar("Key", bound=Hashable)
Value = TypeVar("Value")


class LruCache(Generic[Key, Value]):
    """At most `most` values, which is 1 or more; the one that was used least lately goes first.
    Not thread-safe.
    """

    def __init__(self, max_size: int) -> None:
        self._most = max_size
        self._values: OrderedDict[Key, Value] = OrderedDict()

    def get(self, key: Key, make: Callable[[], Value]) -> Value:
        """The key's value, made if it is not there; raises what `make` raises, and keeps nothing
        then."""
        if key not in self._values:
            self._values[key] = make()
        self._values.move_to_end(key)
        while len(self._values) > self._most:
            self._values.popitem(last=False)
        return self._values[key]

    def values(self) -> ValuesView[Value]:
        """Those that are there; asking for them is no use of them."""
        return self._values.values()


LoadAddedModel = Callable[[str, torch.device], Backbone]

MAX_EXTRACTORS = 2  # a large backbone takes gigabytes of GPU memory
MAX_VOCABULARIES = 16
MAX_WHITENINGS = 2  # one from 98,304 to 512 dimensions takes 201 MB of the device's memory


@dataclass(frozen=True, slots=True)
class DescriptorPipeline:
    """What makes the descriptors of a generation."""

    extractor: Extractor
    centres: ClusterCentres | None = None
    projection: PcaProjection | None = None

    @property
    def spec(self) -> dict[str, Any]:
        return self.extractor.spec(self.centres, self.projection)


class ModelRegistry:
    """Small LRU caches, shared by the thread that prepares and the one that describes."""

    def __init__(
        self,
        store: ObjectStore,
        settings: Settings,
        load_added: LoadAddedModel,
        on_load: Callable[[float], object] = lambda seconds: None,
    ) -> None:
        """`load_added` is that of AddedModels; `on_load` is told how many seconds the loading of an
        extractor took."""
        self._on_load = on_load
        self._store = store
        self._load_added = load_added
        self._settings = settings
        self._lock = threading.RLock()
        self._device = choose_device(settings.device)
        self._extractors: LruCache[str, Extractor] = LruCache(MAX_EXTRACTORS)
        # Of what was loaded once: to run out of memory again for each time would cost photos time.
        self._pass_limits: defaultdict[tuple[object, ...], BatchSizeLimit] = defaultdict(
            BatchSizeLimit
        )
        self._centres: LruCache[UUID, ClusterCentres] = LruCache(MAX_VOCABULARIES)
        self._projections: LruCache[UUID, PcaProjection] = LruCache(MAX_WHITENINGS)

    def extractor(self, name: str, precision: Precision | None = None) -> Extractor:
        """The extractor called `name`, its weights loaded.

        `precision` is that of a generation that is there (see `of_generation`); left out, that of
        new ones: PRECISION.
        """
        recipe = self._settings.recipe(name)
        if precision is None:
            precision = choose_precision(self._settings.precision, recipe, self._device)
        with self._lock:
            found = self._extractors.get(recipe.name, lambda: self._load(recipe, precision))
            return found.at(precision)

    def extractor_of_generation(self, generation: Generation) -> Extractor:
        """The extractor of a generation in the precision that it was begun in, whatever PRECISION
        says and whatever device this is: rows of two precisions never mix.

        Unavailable (`spec_differs`) for a precision that this release does not know.
        """
        precision = generation.spec["precision"]
        if precision not in PRECISIONS:
            raise Unavailable(
                "spec_differs",
                f"Generation {generation.id} was made in {precision}, which this worker can't do: "
                f"it knows {' and '.join(PRECISIONS)}. Upgrade it, or start a model change "
                "(POST /api/v1/generations).",
                generation_id=str(generation.id),
            )
        return self.extractor(generation.extractor, precision)

    def _load(self, recipe: ExtractorConfig, precision: Precision) -> Extractor:
        limit = self._pass_limits[recipe.local_features]
        for loaded in self._extractors.values():
            if loaded.recipe.local_features == recipe.local_features:
                return Extractor(
                    recipe,
                    self._device,
                    precision=precision,
                    backbone=loaded.backbone,
                    limit=limit,
                )
        added = recipe.trained.registered if recipe.trained else None
        started = time.perf_counter()
        made = Extractor(
            recipe,
            self._device,
            precision=precision,
            dino_weights=self._settings.dino_weights,
            backbone=self._load_added(added, self._device) if added else None,
            limit=limit,
        )
        if self._device.type == "cuda":
            made.warm_up(self._settings.batch_photos)
        self._on_load(time.perf_counter() - started)
        return made

    def centres(self, vocabulary: Vocabulary) -> ClusterCentres:
        """The vocabulary's centres, checked against the catalog's hash."""
        with self._lock:
            return self._centres.get(vocabulary.id, lambda: self._read_centres(vocabulary))

    def _read_centres(self, vocabulary: Vocabulary) -> ClusterCentres:
        found = decode_centres(self._store.get(vocabulary.object_key))
        if found.sha256 != vocabulary.sha256:
            raise Unavailable(
                "vocabulary_corrupt",
                f"The vocabulary {vocabulary.id} is not what was stored (its hash differs). "
                "Restore it from a backup, or fit a new one.",
            )
        return found

    def projection(self, whitening: StoredWhitening) -> PcaProjection:
        """The whitening on the device, checked against the catalog's hash."""
        with self._lock:
            return self._projections.get(whitening.id, lambda: self._read_projection(whitening))

    def _read_projection(self, whitening: StoredWhitening) -> PcaProjection:
        stored = decode_whitening(self._store.get(whitening.object_key))
        found = PcaProjection(stored.whitening, self._device)
        if found.sha256 != whitening.sha256:
            raise Unavailable(
                "whitening_corrupt",
                f"The PCA whitening {whitening.id} is not what was stored (its hash differs). "
                "Restore it from a backup, or start a model change.",
            )
        return found

    def pipeline_of_generation(
        self,
        generation: Generation,
        vocabulary: Vocabulary | None,
        whitening: StoredWhitening | None,
    ) -> DescriptorPipeline:
        """What makes the generation's descriptors, of the vocabulary and whitening that it names.

        Raises as `of_generation`, `centres` and `projection` do.
        """
        return DescriptorPipeline(
            self.extractor_of_generation(generation),
            self.centres(vocabulary) if vocabulary else None,
            self.projection(whitening) if whitening else None,
        )


def ensure_model_row(session: Session, extractor: Extractor) -> Model:
    """The catalog's row of the extractor's weights; Misconfigured (`model_missing`) for an added
    model that has been removed meanwhile.
    """
    backbone = extractor.backbone
    trained = extractor.recipe.trained
    if trained is not None and trained.registered is not None:
        # Locked: from this transaction on a generation uses it, and it is removed no more.
        return get_model_for_loading(session, trained.registered, lock=True)
    return get_or_create_model(
        session, backbone.name, backbone.fingerprint, backbone.licence, backbone.card
    )


def generation_spec_columns(
    model: Model,
    pipeline: DescriptorPipeline,
    vocabulary_id: UUID | None,
    whitening_id: UUID | None = None,
) -> dict[str, object]:
    """The columns of a generation that say how its descriptors are made."""
    spec = pipeline.spec
    return {
        "extractor": pipeline.extractor.recipe.name,
        "spec": spec,
        "spec_fingerprint": spec_fingerprint(spec),
        "dimension": spec["dimension"],
        "model_id": model.id,
        "vocabulary_id": vocabulary_id,
        "whitening_id": whitening_id,
    }


def check_spec_matches(
    generation: Generation, pipeline: DescriptorPipeline, *, decoder_matters: bool = True
) -> None:
    """Unavailable (`spec_differs`) when this worker does not reproduce the generation's spec."""
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
        f"This worker would describe photos otherwise than generation {generation.id} was: "
        + "; ".join(f"{k} is {spec.get(k)!r}, was {generation.spec.get(k)!r}" for k in differing)
        + ". Start a model change (POST /api/v1/generations), or run the old packages.",
        generation_id=str(generation.id),
    )
