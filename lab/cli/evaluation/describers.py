"""Describers of data sets: an extractor or a checkpoint, with a descriptor cache. Imports torch."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from rich.progress import Progress

from lab.cli.descriptors.extractors import (
    load_own_vocabulary,
    photo_decoder,
    photo_describer,
    resolve_centres,
)
from lab.datasets.dataset import EvaluationSet
from lab.evaluation.descriptor_cache import CachedDescriber, TimedDescriber
from lab.training.describing import ModelDescriber
from services.cli.descriptors.load_extractor import load_extractor
from services.cli.output import stage_bars
from shared.config.settings import Settings
from shared.descriptors.extractor import Extractor, choose_device, spec_fingerprint
from shared.descriptors.patches import fit_vocabulary, sample_photos
from shared.descriptors.vocabulary import ClusterCentres
from shared.descriptors.vpr_models.checkpoint import load_checkpoint
from shared.extractor_config.configs import get_extractor_config
from shared.imaging.decode import DECODER
from shared.imaging.preprocessing import Pixels

CACHE_FOLDER = "descriptors"
CACHE_BYTES = 20_000_000_000
FIT_SAMPLE_PHOTOS = 1000  # same default as for fits on a map
SEED = 0


@dataclass(slots=True)
class Describer:
    """Computes descriptors of photos; carries the metadata that results report."""

    name: str
    describe: CachedDescriber
    spec: dict[str, Any]
    """Everything that determines a descriptor's value."""
    about: dict[str, Any] = field(default_factory=dict)

    @property
    def fingerprint(self) -> str:
        return spec_fingerprint(self.spec)


def checkpoint_describer(
    checkpoint: Path, image_size: str | tuple[int, int], settings: Settings
) -> Describer:
    """Create a describer from a checkpoint.

    `image_size` is `same` (the model's own), `native`, or (height, width) in pixels.
    """
    loaded = load_checkpoint(checkpoint)
    size = None if image_size == "native" else loaded.config.image_size
    if not isinstance(image_size, str):
        size = image_size
    device = choose_device(settings.device)
    describe = ModelDescriber(
        loaded.model.to(device),
        device,
        size,
        interpolation=loaded.config.interpolation,
        batch_photos=settings.batch_photos if size else 1,
        max_pixels=settings.max_image_pixels,
    )
    spec = {
        "checkpoint": loaded.fingerprint,
        "preprocessing": describe.preprocessing.as_spec(),
        "decoder": DECODER,
    }
    about = {
        "checkpoint": checkpoint.name,
        "model": loaded.config.model_dump(mode="json"),
        "image size": "native" if size is None else f"{size[0]} x {size[1]}",
        "device": device.type,
    }
    about |= {name: loaded.about[name] for name in ("epoch",) if name in loaded.about}
    return Describer(checkpoint.stem, _with_cache(describe, spec, settings), spec, about)


def extractor_describer(
    name: str,
    vocabulary: Path | None,
    evaluation_set: EvaluationSet,
    settings: Settings,
    progress: Progress,
    *,
    fit: bool = False,
    extractor: Extractor | None = None,
) -> Describer:
    """Create a describer from an extractor.

    With `fit`, and if no vocabulary is given or shipped, the vocabulary is fitted on the database
    photos of the set, never on its queries.
    """
    about: dict[str, Any] = {}
    config = get_extractor_config(name, allow_test_extractors=settings.allow_test_extractors)
    extractor = extractor or load_extractor(config, settings)
    if config.needs_vocabulary and vocabulary is None and (fit or not config.shipped_vocabulary):
        database = [photo.path for photo in evaluation_set.database]
        centres: ClusterCentres | None = _fit_vocabulary(extractor, database, settings, progress)
        about["vocabulary"] = "fitted on the database photos"
    else:
        centres = resolve_centres(extractor, load_own_vocabulary(config, vocabulary))
        if centres is not None:
            about["vocabulary"] = vocabulary.name if vocabulary else "shipped"
    spec = extractor.spec(centres)
    describe = photo_describer(extractor, centres, settings)
    about |= {"precision": extractor.precision, "device": extractor.backbone.device.type}
    return Describer(config.name, _with_cache(describe, spec, settings), spec, about)


class FeatureCache(Extractor):
    """Extractor that computes the features of each photo once, for several vocabularies."""

    def __init__(self, name: str, settings: Settings) -> None:
        config = get_extractor_config(name, allow_test_extractors=settings.allow_test_extractors)
        loaded = load_extractor(config, settings)
        super().__init__(config, loaded.backbone.device, backbone=loaded.backbone)
        self._features: dict[bytes, torch.Tensor] = {}

    def features(self, pixels: Pixels) -> torch.Tensor:
        keys = [hashlib.sha256(photo).digest() for photo in pixels]
        new = [index for index, key in enumerate(keys) if key not in self._features]
        if new:
            found = super().features(pixels[new])
            self._features |= {keys[i]: each for i, each in zip(new, found, strict=True)}
        return torch.stack([self._features[key] for key in keys])


def _fit_vocabulary(
    extractor: Extractor, database: Sequence[Path], settings: Settings, progress: Progress
) -> ClusterCentres:
    sampled = sample_photos(len(database), FIT_SAMPLE_PHOTOS, extractor.backbone.width, SEED)
    photos = [database[index] for index in sampled]
    fitted = fit_vocabulary(
        extractor,
        (pixels for _, pixels in photo_decoder(extractor, settings).batches(photos, [])),
        len(photos),
        clusters=extractor.config.clusters,
        seed=SEED,
        on_progress=stage_bars(progress, "vocabulary: "),
    )
    return fitted.centres


def _with_cache(
    describe: TimedDescriber, spec: dict[str, Any], settings: Settings
) -> CachedDescriber:
    return CachedDescriber(
        describe,
        settings.placewise_home / CACHE_FOLDER,
        spec,
        max_bytes=CACHE_BYTES,
    )
