"""A backbone as a stem and numbered stages: what can be frozen and cropped is the same for all."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import nn


class Features(NamedTuple):
    """What a backbone makes of a batch of photos."""

    maps: torch.Tensor
    """(B, C, h, w)."""
    token: torch.Tensor | None
    """(B, C), a transformer's class token; None of networks that have none."""


class StagedBackbone(nn.Module):
    """(B, 3, H, W) float32, normalised as for ImageNet -> Features."""

    def __init__(self, stem: nn.Module, stages: Sequence[nn.Module]) -> None:
        super().__init__()
        self.stem = stem
        self.stages = nn.ModuleList(stages)
        self._frozen: list[nn.Module] = []

    def forward(self, photos: torch.Tensor) -> Features:
        maps = self.stem(photos)
        for stage in self.stages:
            maps = stage(maps)
        return Features(maps, None)

    def patch_side(self) -> int:
        """Photos are this many pixels, or a multiple of it, high and wide."""
        return 1

    def crop(self, count: int) -> None:
        """Keep the first `count` stages."""
        self.stages = self.stages[:count]

    def freeze(self, count: int) -> None:
        """Freeze the stem and the first `count` stages; nothing where `count` is negative.

        Frozen layers have no gradients, and stay in evaluation mode: their BatchNorms neither use
        nor gather a batch's statistics.
        """
        self._frozen = [] if count < 0 else [self.stem, *self.stages[:count]]
        for module in self._frozen:
            module.requires_grad_(False)
        self.train(self.training)

    def train(self, mode: bool = True) -> StagedBackbone:
        super().train(mode)
        for module in self._frozen:
            module.eval()
        return self
