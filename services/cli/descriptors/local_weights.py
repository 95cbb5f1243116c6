"""Availability, provenance and fingerprints of extractor weights on this machine.

Fingerprints are cached, because computing them reads gigabytes of weights. The cache is one JSON
file in `$XDG_CACHE_HOME/placewise` and can be deleted at any time.
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
    here: bool
    """Whether the extractor can be loaded without the network."""
    note: str | None
    """Why the weights are not available."""
    path: str | None
    size_bytes: int | None
    licence: str
    """Licence stated by the publisher or in the folder of the code, or `none found`."""
    fingerprint: str | None
    """The `backbone_fingerprint` of an extractor spec."""


def list_extractor_configs(settings: Settings) -> Iterator[ExtractorConfig]:
    """List the built-in extractors, the default extractor and the allowed torch.hub entries.

    Test extractors are left out, and so are added models, whose weights are in the object store.
    """
    names = dict.fromkeys(
        (*EXTRACTOR_CONFIGS, settings.new_map_extractor, *settings.allowed_hub_extractors)
    )
    configs = (get_extractor_config(name, allow_test_extractors=True) for name in names)
    yield from (config for config in configs if not config.for_tests and config.trained is None)


def inspect_weights(
    config: ExtractorConfig,
    settings: Settings,
    on_reading: Callable[[Path], object] = lambda _path: None,
) -> LocalWeights:
    """Inspect the local weights of an extractor, without network access or loading the model.

    If the fingerprint of a file is not cached, `on_reading` is called with its path before it is
    read to compute the fingerprint.
    """
    if config.hub is not None:
        return _torchhub_weights(config.hub)
    if config.depth is not None:
        return _dinov2_weights(config, settings.dino_weights, on_reading)
    return _packaged_weights(config, on_reading)


def _has_local_weights(config: ExtractorConfig, settings: Settings) -> bool:
    """Whether the weights of a DINOv2 or torch.hub extractor are on this machine and fit it."""
    if config.hub is not None:
        return _torchhub_weights(config.hub).here
    try:
        find_dinov2_weights(config, settings.dino_weights)
    except Misconfigured:
        return False
    return True


def suggest_extractor(settings: Settings) -> str | None:
    """Suggest an extractor for new maps that finds more than the default one, in one line.

    Returns:
        A line, if EXTRACTOR and DINO_MODEL are unset, a GPU is available, and the weights of an
        allowed torch.hub extractor or of DINOv2 (the largest first) are here; otherwise None.
    """
    if {"extractor", "dino_model"} & settings.model_fields_set or settings.device == "cpu":
        return None
    configs = list(list_extractor_configs(settings))
    hub = [config for config in configs if config.hub is not None]
    dinov2 = [config for config in configs if config.depth is not None]
    dinov2.sort(key=lambda config: config.parameters or 0, reverse=True)
    for config in (*hub, *dinov2):
        if _has_local_weights(config, settings):
            break
    else:
        return None
    import torch  # seconds, so only where there are weights

    if not torch.cuda.is_available():
        return None
    return (
        f"a GPU and the weights of {config.name} are here; it finds more than the default "
        f"extractor: EXTRACTOR={config.name} uses it for new maps"
    )


def torchhub_key(hub: TorchHubEntry, code_fingerprint: str) -> str:
    """Cache key of the weights of a torch.hub entry."""
    return f"{hub.module} {code_fingerprint}"


def _packaged_weights(
    config: ExtractorConfig, on_reading: Callable[[Path], object]
) -> LocalWeights:
    from shared.descriptors.backbones.efficientnet_lite0 import (
        PACKAGE,
        EfficientNetLite0,
        weights_path,
    )
    from shared.descriptors.weight_files import file_sha256

    facts = (config.name, f"the package {PACKAGE}", EfficientNetLite0.licence)
    try:
        path = weights_path()
    except Misconfigured as error:
        return _missing_weights(*facts, error)
    return _weights_file(*facts, path, config.backbone, file_sha256, on_reading)


def _dinov2_weights(
    config: ExtractorConfig, weights_file: Path | None, on_reading: Callable[[Path], object]
) -> LocalWeights:
    from shared.descriptors.backbones.dinov2 import Dinov2, dinov2_fingerprint
    from shared.descriptors.backbones.dinov2_weights import hub_repository, open_weights

    layer, facet = config.layer, config.facet
    assert layer is not None
    assert facet is not None
    size = config.backbone.removeprefix("dinov2-")
    source = f"Hugging Face: {hub_repository(size)}" if weights_file is None else "DINO_WEIGHTS"
    facts = (config.name, source, Dinov2.licence)
    try:
        path = find_dinov2_weights(config, weights_file)
    except Misconfigured as error:
        return _missing_weights(*facts, error)

    def fingerprint(file: Path) -> str:
        return dinov2_fingerprint(size, layer, facet, open_weights(file, size))

    # The fingerprint covers only the tensors that this layer and facet use.
    name = f"{config.backbone} {layer} {facet}"
    return _weights_file(*facts, path, name, fingerprint, on_reading)


def _missing_weights(
    extractor: str, source: str, licence: str, error: Misconfigured
) -> LocalWeights:
    return LocalWeights(extractor, source, False, error.detail, None, None, licence, None)


def _weights_file(
    extractor: str,
    source: str,
    licence: str,
    path: Path,
    name: str,
    fingerprint: Callable[[Path], str],
    on_reading: Callable[[Path], object],
) -> LocalWeights:
    """Describe the weights in a file; their record is cached under `name`."""
    stat = path.stat()
    key = f"{name} {path} {stat.st_size} {stat.st_mtime_ns}"
    known = _load_record(key)
    if known is None:
        on_reading(path)
        known = WeightsRecord(fingerprint(path), stat.st_size)
        save_record(key, known)
    return LocalWeights(
        extractor, source, True, None, str(path), known.size_bytes, licence, known.fingerprint
    )


def find_dinov2_weights(config: ExtractorConfig, weights_file: Path | None) -> Path:
    """Return the local weights file; raises Misconfigured where it is missing or does not fit."""
    from shared.descriptors.backbones.dinov2 import check_dinov2_weights
    from shared.descriptors.backbones.dinov2_weights import find_local_weights, open_weights

    assert config.layer is not None
    assert config.facet is not None
    size = config.backbone.removeprefix("dinov2-")
    path = find_local_weights(size, weights_file)
    check_dinov2_weights(size, config.layer, config.facet, open_weights(path, size))
    return path


def _torchhub_weights(hub: TorchHubEntry) -> LocalWeights:
    """Weights of a torch.hub entry count as available once this version of its code was loaded."""
    from shared.descriptors.backbones.torchhub import (
        code_fingerprint,
        find_licence,
        find_local_code,
    )

    source = f"the folder {hub.folder}" if hub.folder else f"github.com/{hub.source}"
    try:
        folder = find_local_code(hub)
    except Misconfigured as error:
        return _missing_weights(hub.name, source, "unknown", error)
    known = _load_record(torchhub_key(hub, code_fingerprint(folder)))
    return LocalWeights(
        hub.name,
        source,
        known is not None,
        None if known else NEVER_LOADED,
        str(folder),
        known.size_bytes if known else None,
        find_licence(folder),
        known.fingerprint if known else None,
    )
