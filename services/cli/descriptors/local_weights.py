"""Availability, provenance and fingerprints of extractor weights on this machine.

Fingerprints are cached, because computing them reads gigabytes of weights. The cache is one JSON
file in `$XDG_CACHE_HOME/placewise` and can be deleted at any time.
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from shared.config.settings import Settings
from shared.errors import Misconfigured
from shared.extractor_config.configs import EXTRACTOR_CONFIGS, ExtractorConfig, get_extractor_config

NEVER_LOADED = "its code is here, but its weights were never loaded: run `placewise models fetch`"


@dataclass(frozen=True, slots=True)
class WeightsRecord:
    """Cached facts about weights that were read or loaded."""

    fingerprint: str
    """The `backbone_fingerprint` of an extractor spec."""
    size_bytes: int


def _load_record(key: str) -> WeightsRecord | None:
    """Look up a record in the cache; None if it is missing."""
    try:
        return WeightsRecord(**_load_cache()[key])
    except (KeyError, TypeError):
        return None


def save_record(key: str, record: WeightsRecord) -> None:
    """Store a record in the cache."""
    path = _cache_path()
    path.parent.mkdir(parents=True, exist_ok=True)
    records = {**_load_cache(), key: asdict(record)}
    # Replaced atomically: another command may be reading.
    with tempfile.NamedTemporaryFile("w", dir=path.parent, delete=False) as file:
        json.dump(records, file, indent=1)
    Path(file.name).replace(path)


def _load_cache() -> dict[str, Any]:
    try:
        records = json.loads(_cache_path().read_text())
    except (FileNotFoundError, ValueError):
        return {}
    return records if isinstance(records, dict) else {}


def _cache_path() -> Path:
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(cache, "placewise", "fingerprints.json")


@dataclass(frozen=True, slots=True)
class LocalWeights:
    """The weights of one extractor, as `placewise models list` shows them."""

    extractor: str
    source: str
    licence: str
    """Licence stated by the publisher or in the folder of the code, or `none found`."""
    available: bool = False
    """Whether the extractor can be loaded without the network."""
    note: str | None = None
    """Why the weights are not available."""
    path: str | None = None
    size_bytes: int | None = None
    fingerprint: str | None = None
    """The `backbone_fingerprint` of an extractor spec."""


def list_extractor_configs(settings: Settings) -> Iterator[ExtractorConfig]:
    """List the built-in extractors, the default extractor and the allowed torch.hub entries.

    Test extractors are left out, and so are added models, whose weights are in the object store.
    """
    names = dict.fromkeys(
        (*EXTRACTOR_CONFIGS, settings.new_map_extractor, *settings.allowed_hub_extractors)
    )
    configs = (get_extractor_config(name, allow_test_extractors=True) for name in names)
    yield from (config for config in configs if not config.for_tests and config.model is None)


def inspect_weights(
    config: ExtractorConfig,
    settings: Settings,
    on_reading: Callable[[Path], object] = lambda _path: None,
) -> LocalWeights:
    """Inspect the local weights of an extractor, without network access or loading the model.

    If the fingerprint of a file is not cached, `on_reading` is called with its path before it is
    read to compute the fingerprint. Code of torch.hub counts as available once it was loaded.
    """
    from shared.descriptors.backbones import backbone_class

    backbone = backbone_class(config)
    source = backbone.weights_source(config, settings.dino_weights)
    try:
        found = backbone.find_weights(config, settings.dino_weights)
    except Misconfigured as error:
        return LocalWeights(config.name, source, backbone.licence, note=error.detail)
    known = _load_record(found.key)
    if known is None and found.fingerprint is not None:
        on_reading(found.path)
        known = WeightsRecord(found.fingerprint(), found.path.stat().st_size)
        save_record(found.key, known)
    weights = LocalWeights(config.name, source, found.licence, path=str(found.path))
    if known is None:
        return replace(weights, note=NEVER_LOADED)
    return replace(weights, available=True, **asdict(known))


def has_local_weights(config: ExtractorConfig, settings: Settings) -> bool:
    """Whether the weights of an extractor are on this machine and fit it."""
    from shared.descriptors.backbones import backbone_class

    try:
        found = backbone_class(config).find_weights(config, settings.dino_weights)
    except Misconfigured:
        return False
    return found.fingerprint is not None or _load_record(found.key) is not None
