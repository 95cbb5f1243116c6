"""Which extractors have their weights on this machine, where they come from, and what they are.

Fingerprints of weights that were computed before: gigabytes need not be read for each list.

One JSON file in the user's cache folder (`$XDG_CACHE_HOME/placewise`, as other tools have theirs).
It may be deleted at any time.
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from shared.config.settings import Settings
from shared.errors import Misconfigured
from shared.extractor_config.configs import EXTRACTOR_CONFIGS, ExtractorConfig, get_extractor_config
from shared.extractor_config.names import TorchHubEntry


@dataclass(frozen=True, slots=True)
class WeightsRecord:
    """What reading or loading the weights has shown."""

    fingerprint: str
    """As `backbone_fingerprint` in an extractor spec."""
    size_bytes: int


def load_record(key: str) -> WeightsRecord | None:
    """What `remember` was given for that key; None when it is not known any more."""
    try:
        return WeightsRecord(**_load_cache()[key])
    except (KeyError, TypeError):
        return None


def save_record(key: str, record: WeightsRecord) -> None:
    """Keep it for the next command."""
    path = _cache_path()
    path.parent.mkdir(parents=True, exist_ok=True)
    everything = {**_load_cache(), key: asdict(record)}
    # Another command may be reading.
    with tempfile.NamedTemporaryFile("w", dir=path.parent, delete=False) as file:
        json.dump(everything, file, indent=1)
    Path(file.name).replace(path)


def file_key(extractor: str, path: Path) -> str:
    """A key that changes with the file."""
    there = path.stat()
    return f"{extractor} {path} {there.st_size} {there.st_mtime_ns}"


def _load_cache() -> dict[str, Any]:
    try:
        found = json.loads(_cache_path().read_text())
    except (FileNotFoundError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _cache_path() -> Path:
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(cache, "placewise", "fingerprints.json")


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
    from shared.descriptors.backbones.efficientnet_lite0 import (
        PACKAGE,
        EfficientNetLite0,
        weights_path,
    )
    from shared.descriptors.weight_files import file_sha256

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
    from shared.descriptors.backbones.dinov2 import Dinov2, check_dinov2_weights, dinov2_fingerprint
    from shared.descriptors.backbones.dinov2_weights import (
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
    from shared.descriptors.backbones.torchhub import (
        code_fingerprint,
        find_licence,
        find_local_code,
    )

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
