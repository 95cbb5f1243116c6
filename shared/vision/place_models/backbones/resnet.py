"""ResNet (He et al. 2016) and ResNeXt (Xie et al. 2017) by torchvision: strides 4, 8, 16, 32."""

from __future__ import annotations

from pathlib import Path

from torch import nn

from shared.vision.place_models.backbones.pretrained import load_torchvision_network
from shared.vision.place_models.backbones.staged import StagedBackbone


def build_resnet(name: str, pretrained: bool, weights: Path | None) -> StagedBackbone:
    """`name` as in `config.STAGES`."""
    network = load_torchvision_network(name, pretrained, weights)
    stem = nn.Sequential(network.conv1, network.bn1, network.relu, network.maxpool)
    return StagedBackbone(stem, [network.layer1, network.layer2, network.layer3, network.layer4])
