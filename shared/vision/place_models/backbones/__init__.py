"""Backbones of place models by name: photos to maps of local features. One module per family."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from shared.vision.place_models.backbones.resnet import resnet
from shared.vision.place_models.backbones.staged import Features, StagedBackbone
from shared.vision.place_models.config import STAGES, ModelConfig

__all__ = ["Features", "StagedBackbone", "build_backbone"]

Build = Callable[[str, bool, Path | None], StagedBackbone]

_FAMILIES: dict[str, Build] = {"resnet": resnet, "resnext": resnet}


def build_backbone(config: ModelConfig, weights: Path | None) -> StagedBackbone:
    """The backbone, cropped and frozen as the config says, in evaluation mode.

    `weights`: a file of pretrained weights, None for those of the hub's cache. Raises
    Misconfigured: `weights_missing`, `weights_unfit`.
    """
    name = config.backbone_arch
    family = next(build for part, build in _FAMILIES.items() if name.startswith(part))
    backbone = family(name, config.pretrained, weights)
    assert len(backbone.stages) == STAGES[name]
    backbone.crop(config.stages)
    backbone.freeze(config.layers_to_freeze)
    return backbone.eval()
