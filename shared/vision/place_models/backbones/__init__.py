"""Backbones of place models by name: photos to maps of local features. One module per family."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from shared.vision.place_models.backbones.dinov2 import dinov2
from shared.vision.place_models.backbones.efficientnet import efficientnet_b0, efficientnet_lite0
from shared.vision.place_models.backbones.resnet import resnet
from shared.vision.place_models.backbones.staged import Features, StagedBackbone
from shared.vision.place_models.backbones.swin import swin
from shared.vision.place_models.config import STAGES, ModelConfig

__all__ = ["Features", "StagedBackbone", "build_backbone"]

Build = Callable[[str, bool, Path | None], StagedBackbone]

_BUILD: dict[str, Build] = {
    "resnet18": resnet,
    "resnet34": resnet,
    "resnet50": resnet,
    "resnet101": resnet,
    "resnext50_32x4d": resnet,
    "efficientnet_b0": efficientnet_b0,
    "efficientnet_lite0": efficientnet_lite0,
    "swin_t": swin,
    "dinov2_vits14": dinov2,
    "dinov2_vitb14": dinov2,
    "dinov2_vitl14": dinov2,
    "dinov2_vitg14": dinov2,
}


def build_backbone(config: ModelConfig, weights: Path | None) -> StagedBackbone:
    """The backbone, cropped and frozen as the config says, in evaluation mode.

    `weights`: a file of pretrained weights, None for those of the hub's cache. Raises
    Misconfigured: `weights_missing`, `weights_unfit`, `download_corrupt`.
    """
    name = config.backbone_arch
    backbone = _BUILD[name](name, config.pretrained, weights)
    assert len(backbone.stages) == STAGES[name]
    backbone.crop(config.stages)
    backbone.freeze(config.layers_to_freeze)
    return backbone.eval()
