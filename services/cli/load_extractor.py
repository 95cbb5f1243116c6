"""The extractor that a command describes photos with on this machine. Imports torch."""

from __future__ import annotations

from shared.recipes import Recipe
from shared.settings import Settings
from shared.vision.extractors import Extractor, choose_device
from shared.vision.precision import choose_precision


def load_extractor(recipe: Recipe, settings: Settings) -> Extractor:
    """With its weights loaded, on the device and in the precision of the settings, as a worker has
    it for a new generation.

    Raises as `Extractor` and `choose_device` do.
    """
    device = choose_device(settings.device)
    return Extractor(
        recipe,
        device,
        precision=choose_precision(settings.precision, recipe, device),
        dino_weights=settings.dino_weights,
    )
