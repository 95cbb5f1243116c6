"""Which extractors have their weights on this machine, where they come from, and what they are."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from services.cli.fingerprints import WeightsRecord, file_key, load_record, save_record
from shared.errors import Misconfigured
from shared.recipes import EXTRACTOR_CONFIGS, ExtractorConfig, get_extractor_config
from shared.settings import Settings
from shared.torchhub_names import TorchHubEntry


@dataclass(frozen=True, slots=True)
class LocalWeights:
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


def list_recipes(settings: Settings) -> Iterator[ExtractorConfig]:
    """Every extractor by its own name, that of new maps, and the torch.hub entries that are
    allowed; not those for tests, nor models that were added, which lie in the object store.
    """
    names = dict.fromkeys(
        (*EXTRACTOR_CONFIGS, settings.new_map_extractor, *settings.allowed_hub_extractors)
    )
    recipes = (get_extractor_config(name, allow_test_extractors=True) for name in names)
    yield from (recipe for recipe in recipes if not recipe.for_tests and recipe.trained is None)


def inspect_weights(
    recipe: ExtractorConfig,
    settings: Settings,
    on_reading: Callable[[Path], object] = lambda _path: None,
) -> LocalWeights:
    """What is here of the extractor; asks no network and loads no network.

    A fingerprint that is not known yet is computed, which reads the file: `on_reading` is told.
    """
    if recipe.hub is not None:
        return _torchhub_weights(recipe.hub)
    if recipe.depth is not None:
        return _dinov2_weights(recipe, settings.dino_weights, on_reading)
    return _packaged_weights(recipe, on_reading)


def torchhub_key(hub: TorchHubEntry, code_fingerprint: str) -> str:
    """Under which the weights of a torch.hub entry are remembered once they were loaded."""
    return f"{hub.module} {code_fingerprint}"


def _packaged_weights(
    recipe: ExtractorConfig, on_reading: Callable[[Path], object]
) -> LocalWeights:
    from shared.vision.backbones.efficientnet_lite0 import PACKAGE, EfficientNetLite0, weights_path
    from shared.vision.download import file_sha256

    source, find_licence = f"the package {PACKAGE}", EfficientNetLite0.licence
    try:
        path = weights_path()
    except Misconfigured as error:
        return LocalWeights(
            recipe.name, source, False, error.detail, None, None, find_licence, None
        )
    known = _cached_record(recipe.backbone, path, file_sha256, on_reading)
    return LocalWeights(
        recipe.name,
        source,
        True,
        None,
        str(path),
        known.size_bytes,
        find_licence,
        known.fingerprint,
    )


def _dinov2_weights(
    recipe: ExtractorConfig, weights_file: Path | None, on_reading: Callable[[Path], object]
) -> LocalWeights:
    from shared.vision.backbones.dinov2 import Dinov2, check_dinov2_weights, dinov2_fingerprint
    from shared.vision.backbones.dinov2_weights import (
        find_local_weights,
        hub_repository,
        open_weights,
    )

    layer, facet = recipe.layer, recipe.facet
    assert layer is not None
    assert facet is not None
    size = recipe.backbone.removeprefix("dinov2-")
    source = f"Hugging Face: {hub_repository(size)}" if weights_file is None else "DINO_WEIGHTS"
    try:
        path = find_local_weights(size, weights_file)
        check_dinov2_weights(size, layer, facet, open_weights(path, size))
    except Misconfigured as error:
        return LocalWeights(
            recipe.name, source, False, error.detail, None, None, Dinov2.licence, None
        )

    def fingerprint(file: Path) -> str:
        return dinov2_fingerprint(size, layer, facet, open_weights(file, size))

    # The layer and the facet say which of the file's tensors are in use.
    known = _cached_record(f"{recipe.backbone} {layer} {facet}", path, fingerprint, on_reading)
    return LocalWeights(
        recipe.name,
        source,
        True,
        None,
        str(path),
        known.size_bytes,
        Dinov2.licence,
        known.fingerprint,
    )


def _torchhub_weights(hub: TorchHubEntry) -> LocalWeights:
    """Where its weights lie, only its code knows: they are here once it was loaded as it is now."""
    from shared.vision.torchhub_code import code_fingerprint, find_licence, find_local_code

    source = f"the folder {hub.folder}" if hub.folder else f"github.com/{hub.source}"
    try:
        folder = find_local_code(hub)
    except Misconfigured as error:
        return LocalWeights(hub.name, source, False, error.detail, None, None, "unknown", None)
    known = load_record(torchhub_key(hub, code_fingerprint(folder)))
    return LocalWeights(
        hub.name,
        source,
        known is not None,
        None if known else "its code is here, but was never loaded: `placewise models fetch`",
        str(folder),
        known.size_bytes if known else None,
        find_licence(folder),
        known.fingerprint if known else None,
    )


def _cached_record(
    name: str, path: Path, fingerprint: Callable[[Path], str], on_reading: Callable[[Path], object]
) -> WeightsRecord:
    key = file_key(name, path)
    known = load_record(key)
    if known is None:
        on_reading(path)
        known = WeightsRecord(fingerprint(path), path.stat().st_size)
        save_record(key, known)
    return known
