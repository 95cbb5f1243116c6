"""Availability and provenance of extractor weights on this machine."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from shared.config.settings import Settings
from shared.errors import Misconfigured
from shared.extractor_config.configs import EXTRACTOR_CONFIGS, ExtractorConfig, get_extractor_config


@dataclass(frozen=True, slots=True)
class LocalWeights:
    """The weights of one extractor, as `placewise models list` shows them."""

    extractor: str
    source: str
    licence: str
    """Licence stated by the publisher or in the folder of the code, or `none found`."""
    available: bool = False
    """Whether its weights are here; of a torch.hub entry, its code."""
    note: str | None = None
    """Why the weights are not available."""
    path: str | None = None
    size_bytes: int | None = None
    """None for a torch.hub entry, whose code alone knows where its weights are."""


def list_extractor_configs(settings: Settings) -> Iterator[ExtractorConfig]:
    """List the built-in extractors, the default extractor and the allowed torch.hub entries.

    Test extractors are left out, and so are added models, whose weights are in the object store.
    """
    names = dict.fromkeys(
        (*EXTRACTOR_CONFIGS, settings.new_map_extractor, *settings.allowed_hub_extractors)
    )
    configs = (get_extractor_config(name, allow_test_extractors=True) for name in names)
    yield from (config for config in configs if not config.for_tests and config.model is None)


def inspect_weights(config: ExtractorConfig, settings: Settings) -> LocalWeights:
    """Inspect the local weights of an extractor, without network access or loading the model."""
    from shared.descriptors.backbones import backbone_class

    backbone = backbone_class(config)
    source = backbone.weights_source(config, settings.dino_weights)
    try:
        path, licence = backbone.find_weights(config, settings.dino_weights)
    except Misconfigured as error:
        return LocalWeights(config.name, source, backbone.licence, note=error.detail)
    size_bytes = path.stat().st_size if path.is_file() else None
    return LocalWeights(config.name, source, licence, True, None, str(path), size_bytes)
