"""Extractors to measure: with the weights that are here, or with random ones where there are none.

Random weights take the same time and memory, and say how far two ways of computing are apart. What
they find means nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from services.cli.configuration import read_settings
from shared.errors import Misconfigured
from shared.recipes import ExtractorConfig
from shared.settings import Settings
from shared.vision.backbones.dinov2 import SHAPES
from shared.vision.backbones.dinov2_weights import find_local_weights
from shared.vision.extractors import Extractor, choose_device
from shared.vision.fit_photos import fit_vocabulary
from shared.vision.precision import Precision
from shared.vision.resample import Pixels
from shared.vision.vocabulary import ClusterCentres
from tests.support.vit import random_weights, save


@dataclass(frozen=True, slots=True)
class BenchmarkedExtractor:
    """What is measured, and with which weights."""

    recipe: ExtractorConfig
    device: torch.device
    settings: Settings
    dino_weights: Path | None
    random: bool

    @classmethod
    def of(cls, extractor: str, device: str, folder: Path) -> BenchmarkedExtractor:
        """`folder` takes random weights, where there are no others. Raises Misconfigured for an
        extractor or a device that can't be had.
        """
        settings = read_settings()
        recipe = settings.recipe(extractor)
        weights, random = settings.dino_weights, False
        if recipe.depth is not None:
            size = recipe.backbone.removeprefix("dinov2-")
            try:
                weights = find_local_weights(size, weights)
            except Misconfigured as error:
                if error.code != "weights_missing":
                    raise
                weights = save(random_weights(SHAPES[size]), folder / f"{size}.safetensors")
                random = True
        return cls(recipe, choose_device(device), settings, weights, random)

    def load(self, precision: Precision) -> Extractor:
        return Extractor(
            self.recipe, self.device, precision=precision, dino_weights=self.dino_weights
        )

    @property
    def title(self) -> str:
        name = (
            torch.cuda.get_device_name(self.device)
            if self.device.type == "cuda"
            else f"{torch.get_num_threads()} CPU threads"
        )
        return f"{self.recipe.name}{', random weights' if self.random else ''}, {name}"


def fit_or_load_centres(extractor: Extractor, photos: list[Pixels]) -> ClusterCentres | None:
    """The shipped ones, or learnt from the photos where some are needed and none are shipped."""
    if not extractor.recipe.needs_vocabulary:
        return None
    shipped = extractor.shipped_vocabulary()
    if shipped is not None:
        return shipped[0]
    clusters = extractor.recipe.clusters
    return fit_vocabulary(extractor, [photos], len(photos), clusters=clusters, seed=0).centres
