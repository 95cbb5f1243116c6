"""A backbone as a stem and numbered stages: what can be frozen and cropped is the same for all."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import torch
from torch import nn


class FeatureMaps(NamedTuple):
    """What a backbone makes of a batch of photos."""

    maps: torch.Tensor
    """(B, C, h, w)."""
    token: torch.Tensor | None = None
    """(B, C), a transformer's class token; None of networks that have none."""


class StagedBackbone(nn.Module):
    """(B, 3, H, W) float32, normalised as for ImageNet -> Features."""

    patch: ClassVar[int] = 1
    """Height and width of a photo have to be multiples of so many pixels."""

    def __init__(
        self, stem: nn.Module, stages: Sequence[nn.Module], norm: nn.Module | None = None
    ) -> None:
        """`norm` comes after the last stage."""
        super().__init__()
        self.stem = stem
        self.stages = nn.ModuleList(stages)
        self.norm = nn.Identity() if norm is None else norm
        self._frozen: list[nn.Module] = []

    def forward(self, photos: torch.Tensor) -> FeatureMaps:
        return FeatureMaps(self._run(photos))

    def _run(self, photos: torch.Tensor) -> torch.Tensor:
        found: torch.Tensor = self.stem(photos)
        for stage in self.stages:
            found = stage(found)
        normed: torch.Tensor = self.norm(found)
        return normed

    def crop(self, count: int) -> None:
        """Keep the first `count` stages."""
        self.stages = self.stages[:count]

    def freeze(self, count: int) -> None:
        """Freeze the stem and the first `count` stages, and with all of them what comes after;
        nothing where `count` is negative.

        Frozen layers have no gradients, and stay in evaluation mode: their BatchNorms neither use
        nor gather a batch's statistics.
        """
        if count < 0:
            return
        self._frozen = [self.stem, *self.stages[:count]]
        if count >= len(self.stages):
            self._frozen.append(self.norm)
        for module in self._frozen:
            module.requires_grad_(False)

    def train(self, mode: bool = True) -> StagedBackbone:
        super().train(mode)
        for module in self._frozen:
            module.eval()
        return self
