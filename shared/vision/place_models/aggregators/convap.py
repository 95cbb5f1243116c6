"""Conv-AP (Ali-bey, Chaib-draa and Giguere 2022, "GSV-Cities", section 4.2).

y   = 1 x 1 convolution of x to `out_channels`
row = means of y over s1 x s2 cells of the map, channel-major
row <- row / |row|
"""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import nn

from shared.vision.place_models.aggregators.base import Aggregator, Size, normalise_rows


class ConvAP(Aggregator):
    inferred: ClassVar = {"in_channels": "channels"}

    def __init__(
        self,
        in_channels: Size,
        out_channels: Size = 512,
        s1: Size = 2,
        s2: Size = 2,
    ) -> None:
        """`s1` rows of cells, `s2` columns."""
        super().__init__(out_channels * s1 * s2)
        self.channels = nn.Conv2d(in_channels, out_channels, kernel_size=1)
        self.cells = nn.AdaptiveAvgPool2d((s1, s2))

    def forward(self, maps: torch.Tensor) -> torch.Tensor:
        return normalise_rows(self.cells(self.channels(maps)))
