"""Backbones of place models by name: photos to maps of local features. One module per family."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from shared.vision.place_models.backbones.dinov2 import build_dinov2
from shared.vision.place_models.backbones.efficientnet import (
    build_efficientnet_b0,
    build_efficientnet_lite0,
)
from shared.vision.place_models.backbones.resnet import build_resnet
from shared.vision.place_models.backbones.staged import FeatureMaps, StagedBackbone
from shared.vision.place_models.backbones.swin import build_swin
from shared.vision.place_models.config import STAGES, VprModelConfig

__all__ = ["FeatureMaps", "StagedBackbone", "build_backbone"]

BackboneBuilder = Callable[[str, bool, Path | None], StagedBackbone]

_BUILDERS: dict[str, BackboneBuilder] = {
    "resnet18": build_resnet,
    "resnet34": build_resnet,
    "resnet50": build_resnet,
    "resnet101": build_resnet,
    "resnext50_32x4d": build_resnet,
    "efficientnet_b0": build_efficientnet_b0,
    "efficientnet_lite0": build_efficientnet_lite0,
    "swin_t": build_swin,
    "dinov2_vits14": build_dinov2,
    "dinov2_vitb14": build_dinov2,
    "dinov2_vitl14": build_dinov2,
    "dinov2_vitg14": build_dinov2,
}


def build_backbone(config: VprModelConfig, weights: Path | None) -> StagedBackbone:
    """The backbone, cropped and frozen as the config says, in evaluation mode.

    `weights`: a file of pretrained weights, None for those of the hub's cache. Raises
    Misconfigured: `weights_missing`, `weights_unfit`, `download_corrupt`.
    """
    name = config.backbone_arch
    backbone = _BUILDERS[name](name, config.pretrained, weights)
    assert len(backbone.stages) == STAGES[name]
    backbone.crop(config.stages)
    backbone.freeze(config.layers_to_freeze)
    return backbone.eval()
