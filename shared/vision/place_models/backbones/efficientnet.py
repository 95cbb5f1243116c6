"""EfficientNet-B0 (Tan and Le 2019) by torchvision, and its Lite0 by timm.

Stages 1 to 7 are the groups of blocks (strides 2, 4, 8, 16, 16, 32, 32), the 8th is the convolution
to 1,280 channels before the classifier.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import nn

from shared.vision.backbones.dinov2 import MEAN as IMAGENET_MEAN
from shared.vision.backbones.dinov2 import STD as IMAGENET_STD
from shared.vision.backbones.efficientnet_lite0 import MEAN, STD, published_network
from shared.vision.place_models.backbones.pretrained import (
    check_weights_file,
    load_state,
    load_torchvision_network,
    read_tensors,
)
from shared.vision.place_models.backbones.staged import StagedBackbone


def build_efficientnet_b0(name: str, pretrained: bool, weights: Path | None) -> StagedBackbone:
    stem, *stages = load_torchvision_network(name, pretrained, weights).features
    return StagedBackbone(stem, stages)


def build_efficientnet_lite0(name: str, pretrained: bool, weights: Path | None) -> StagedBackbone:
    """Published weights come with the package of the embedded default, or from a file in timm's
    naming."""
    import timm  # takes seconds, which not every command need pay

    network: Any
    if not pretrained:
        network = timm.create_model("tf_efficientnet_lite0", pretrained=False)
    elif weights is None:
        network = published_network()
    else:
        network = timm.create_model("tf_efficientnet_lite0", pretrained=False)
        load_state(network, read_tensors(check_weights_file(weights, name), name), weights, name)
    stem = nn.Sequential(Renormalise(), network.conv_stem, network.bn1)
    return StagedBackbone(stem, [*network.blocks, nn.Sequential(network.conv_head, network.bn2)])


class Renormalise(nn.Module):
    """From ImageNet's mean and deviation to those that Lite0 was trained with."""

    def __init__(self) -> None:
        super().__init__()
        mean, std = torch.tensor(IMAGENET_MEAN), torch.tensor(IMAGENET_STD)
        self.register_buffer("scale", (std / torch.tensor(STD)).view(3, 1, 1))
        self.register_buffer(
            "shift", ((mean - torch.tensor(MEAN)) / torch.tensor(STD)).view(3, 1, 1)
        )
        self.scale: torch.Tensor
        self.shift: torch.Tensor

    def forward(self, photos: torch.Tensor) -> torch.Tensor:
        return photos * self.scale + self.shift
