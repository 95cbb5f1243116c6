"""Which extractors have their weights on this machine, where they come from, and what they are."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from services.cli.fingerprints import Known, file_key, remember, remembered
from shared.errors import Misconfigured
from shared.recipes import RECIPES, Recipe, get_recipe
from shared.settings import Settings
from shared.torchhub_names import HubEntry


@dataclass(frozen=True, slots=True)
class Weights:
    """The weights of one extractor, as `placewise models list` shows them."""

    extractor: str
    source: str
    here: bool
    """Whether the extractor can be loaded without the network."""
    note: str | None
    """What is in the way when they are not here."""
    path: str | None
    size_bytes: int | None
    licence: str
    """As their publisher or the folder of the code says it; `none found` is said plainly."""
    fingerprint: str | None
    """As `backbone_fingerprint` in an extractor spec."""


def listed(settings: Settings) -> Iterator[Recipe]:
    """Every extractor by its own name, that of new maps, and the torch.hub entries that are
    allowed; not those for tests, nor models that were added, which lie in the object store.
    """
    names = dict.fromkeys((*RECIPES, settings.new_map_extractor, *settings.allowed_hub_extractors))
    recipes = (get_recipe(name, allow_test_extractors=True) for name in names)
    yield from (recipe for recipe in recipes if not recipe.for_tests and recipe.trained is None)


def look(
    recipe: Recipe, settings: Settings, on_reading: Callable[[Path], object] = lambda _path: None
) -> Weights:
    """What is here of the extractor; asks no network and loads no network.

    A fingerprint that is not known yet is computed, which reads the file: `on_reading` is told.
    """
    if recipe.hub is not None:
        return _of_torchhub(recipe.hub)
    if recipe.depth is not None:
        return _of_dinov2(recipe, settings.dino_weights, on_reading)
    return _of_package(recipe, on_reading)


def hub_key(hub: HubEntry, code_fingerprint: str) -> str:
    """Under which the weights of a torch.hub entry are remembered once they were loaded."""
    return f"{hub.module} {code_fingerprint}"


def _of_package(recipe: Recipe, on_reading: Callable[[Path], object]) -> Weights:
    from shared.vision.backbones.efficientnet_lite0 import PACKAGE, EfficientNetLite0, weights_path
    from shared.vision.download import file_sha256

    source, licence = f"the package {PACKAGE}", EfficientNetLite0.licence
    try:
        path = weights_path()
    except Misconfigured as error:
        return Weights(recipe.name, source, False, error.detail, None, None, licence, None)
    known = _known(recipe.backbone, path, file_sha256, on_reading)
    return Weights(
        recipe.name, source, True, None, str(path), known.size_bytes, licence, known.fingerprint
    )


def _of_dinov2(recipe: Recipe, given: Path | None, on_reading: Callable[[Path], object]) -> Weights:
    from shared.vision.backbones.dinov2 import Dinov2, check_weights, weights_fingerprint
    from shared.vision.backbones.dinov2_weights import (
        hub_repository,
        open_weights,
        weights_at_hand,
    )

    layer, facet = recipe.layer, recipe.facet
    assert layer is not None
    assert facet is not None
    size = recipe.backbone.removeprefix("dinov2-")
    source = f"Hugging Face: {hub_repository(size)}" if given is None else "DINO_WEIGHTS"
    try:
        path = weights_at_hand(size, given)
        check_weights(size, layer, facet, open_weights(path, size))
    except Misconfigured as error:
        return Weights(recipe.name, source, False, error.detail, None, None, Dinov2.licence, None)

    def fingerprint(file: Path) -> str:
        return weights_fingerprint(size, layer, facet, open_weights(file, size))

    # The layer and the facet say which of the file's tensors are in use.
    known = _known(f"{recipe.backbone} {layer} {facet}", path, fingerprint, on_reading)
    return Weights(
        recipe.name,
        source,
        True,
        None,
        str(path),
        known.size_bytes,
        Dinov2.licence,
        known.fingerprint,
    )


def _of_torchhub(hub: HubEntry) -> Weights:
    """Where its weights lie, only its code knows: they are here once it was loaded as it is now."""
    from shared.vision.torchhub_code import code_at_hand, code_fingerprint, licence

    source = f"the folder {hub.folder}" if hub.folder else f"github.com/{hub.source}"
    try:
        folder = code_at_hand(hub)
    except Misconfigured as error:
        return Weights(hub.name, source, False, error.detail, None, None, "unknown", None)
    known = remembered(hub_key(hub, code_fingerprint(folder)))
    return Weights(
        hub.name,
        source,
        known is not None,
        None if known else "its code is here, but was never loaded: `placewise models fetch`",
        str(folder),
        known.size_bytes if known else None,
        licence(folder),
        known.fingerprint if known else None,
    )


def _known(
    what: str, path: Path, fingerprint: Callable[[Path], str], on_reading: Callable[[Path], object]
) -> Known:
    key = file_key(what, path)
    known = remembered(key)
    if known is None:
        on_reading(path)
        known = Known(fingerprint(path), path.stat().st_size)
        remember(key, known)
    return known
