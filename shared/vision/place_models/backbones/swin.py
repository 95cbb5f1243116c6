"""Swin-T (Liu et al. 2021) by torchvision: strides 4, 8, 16, 32; photos of any size."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import nn

from shared.vision.place_models.backbones.pretrained import load_torchvision_network
from shared.vision.place_models.backbones.staged import FeatureMaps, StagedBackbone


class SwinBackbone(StagedBackbone):
    def forward(self, photos: torch.Tensor) -> FeatureMaps:
        return FeatureMaps(self._run(photos).permute(0, 3, 1, 2))  # channels come last in it

    def crop(self, count: int) -> None:
        """The last norm belongs to the last stage and goes with it."""
        if count < len(self.stages):
            self.norm = nn.Identity()
        super().crop(count)


def build_swin(name: str, pretrained: bool, weights: Path | None) -> StagedBackbone:
    network = load_torchvision_network(name, pretrained, weights)
    stem, first, *later = network.features
    merged = [
        nn.Sequential(merge, blocks) for merge, blocks in zip(later[::2], later[1::2], strict=True)
    ]
    return SwinBackbone(stem, [first, *merged], network.norm)
