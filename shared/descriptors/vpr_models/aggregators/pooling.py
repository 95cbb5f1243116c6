"""Aggregators by pooling: AVG, GeM, CosPlace and Conv-AP.

AVG and GeM: the descriptor is as long as the map has channels.

    AVG:  row_c = mean over (h, w) of x_c
    GeM:  row_c = (mean over (h, w) of max(x_c, eps)^p)^(1 / p)      p is learnt

and row <- row / |row|. GeM is the generalised mean of Radenovic, Tolias and Chum (TPAMI 2019, eq. 3
and 4), one p for all channels as in their code.

CosPlace's head (Berton, Masone and Caputo 2022, "Rethinking Visual Geo-localization"):

    y   = x / |x| over the channels, at each position
    row = W GeM(y) + b              GeM with a learnt p
    row <- row / |row|

Conv-AP (Ali-bey, Chaib-draa and Giguere 2022, "GSV-Cities", section 4.2):

    y   = 1 x 1 convolution of x to `out_channels`
    row = means of y over s1 x s2 cells of the map, channel-major
    row <- row / |row|
"""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import nn
from torch.nn.functional import normalize

from shared.descriptors.vpr_models.aggregators.base import (
    Aggregator,
    Positive,
    Size,
    normalise_rows,
)

GEM_POWER = 3.0
GEM_EPS = 1e-6


class AveragePooling(Aggregator):
    """Mean over the positions of the map."""

    inferred: ClassVar = {"in_channels": "channels"}

    def __init__(self, in_channels: Size) -> None:
        super().__init__(in_channels)

    def forward(self, maps: torch.Tensor) -> torch.Tensor:
        return normalise_rows(maps.mean(dim=(-2, -1)))


class GeM(Aggregator):
    """Generalised mean over the positions of the map."""

    inferred: ClassVar = {"in_channels": "channels"}

    def __init__(self, in_channels: Size, p: Positive = GEM_POWER, eps: Positive = GEM_EPS) -> None:
        super().__init__(in_channels)
        self.pool = _GeneralizedMeanPooling(p, eps)

    def forward(self, maps: torch.Tensor) -> torch.Tensor:
        return normalise_rows(self.pool(maps))


class _GeneralizedMeanPooling(nn.Module):
    """Generalised mean: (B, C, h, w) -> (B, C) float32, not normalised."""

    def __init__(self, p: float, eps: float) -> None:
        super().__init__()
        self.p = nn.Parameter(torch.tensor([p]))
        self.eps = eps

    def forward(self, maps: torch.Tensor) -> torch.Tensor:
        # In float32 also under autocast: cubes overflow half precision.
        powers = maps.float().clamp(min=self.eps).pow(self.p)
        pooled: torch.Tensor = powers.mean(dim=(-2, -1)).pow(1.0 / self.p)
        return pooled


class CosPlace(Aggregator):
    """GeM pooling of normalised features and a linear projection."""

    inferred: ClassVar = {"in_dim": "channels"}

    def __init__(self, in_dim: Size, out_dim: Size = 512) -> None:
        super().__init__(out_dim)
        self.pool = _GeneralizedMeanPooling(GEM_POWER, GEM_EPS)
        self.linear = nn.Linear(in_dim, out_dim)

    def forward(self, maps: torch.Tensor) -> torch.Tensor:
        return normalise_rows(self.linear(self.pool(normalize(maps, dim=1))))


class ConvAP(Aggregator):
    """1 x 1 convolution and average pooling in a grid of cells."""

    inferred: ClassVar = {"in_channels": "channels"}

    def __init__(
        self,
        in_channels: Size,
        out_channels: Size = 512,
        s1: Size = 2,
        s2: Size = 2,
    ) -> None:
        """`s1` and `s2`: rows and columns of the grid of cells."""
        super().__init__(out_channels * s1 * s2)
        self.channels = nn.Conv2d(in_channels, out_channels, kernel_size=1)
        self.cells = nn.AdaptiveAvgPool2d((s1, s2))

    def forward(self, maps: torch.Tensor) -> torch.Tensor:
        return normalise_rows(self.cells(self.channels(maps)))
