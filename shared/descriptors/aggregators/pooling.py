"""Aggregators by pooling: average and GeM of patch features; AVG, GeM, CosPlace, Conv-AP of maps.

    AVG:  row_d = mean over the positions of x_d
    GeM:  row_d = (mean over the positions of max(x_d, eps)^p)^(1 / p)

and row <- row / |row|: the descriptor is as long as one local feature. GeM is the generalised mean
of Radenovic, Tolias and Chum (TPAMI 2019, "Fine-tuning CNN Image Retrieval with No Human
Annotation", eq. 3 and 4) with the clamp of their code: negative values count as eps. (AnyLoc's own
GeM keeps the sign of the mean of cubes instead.) In trained networks one p for all channels is
learnt; of pretrained features it is 3, and patches whose feature is zero are left out of both
means. If all are zero, the row is zero. Features have to be finite: the clamp would hide some
values that are not.

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

from shared.descriptors.aggregators.base import Aggregator, Positive, Size, normalise_rows

GEM_POWER = 3.0
GEM_EPS = 1e-6


@torch.inference_mode()
def average_pooling(features: torch.Tensor) -> torch.Tensor:
    """Average (B, patches, D) float32 features to (B, D) unit rows."""
    # Zero patches change the length of the mean alone, which is normalised.
    return normalize(features.mean(dim=1), dim=-1)


@torch.inference_mode()
def gem_pooling(features: torch.Tensor) -> torch.Tensor:
    """Pool (B, patches, D) float32 features by the generalised mean to (B, D) unit rows."""
    nonzero = (features != 0).any(dim=-1, keepdim=True)  # (B, patches, 1)
    return normalize(_generalised_mean(features, GEM_POWER, GEM_EPS, (1,), nonzero), dim=-1)


def _generalised_mean(
    x: torch.Tensor,
    power: float | torch.Tensor,
    eps: float,
    dims: tuple[int, ...],
    counted: torch.Tensor | None = None,
) -> torch.Tensor:
    """Return the generalised mean over `dims`, of the counted positions, by default all."""
    powers = x.clamp(min=eps).pow(power)
    if counted is None:
        means = powers.mean(dim=dims)
    else:
        means = (powers * counted).sum(dim=dims) / counted.sum(dim=dims).clamp(min=1)
    return means.pow(1 / power)


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
    """Generalised mean with a learnt p: (B, C, h, w) -> (B, C) float32, not normalised."""

    def __init__(self, p: float, eps: float) -> None:
        super().__init__()
        self.p = nn.Parameter(torch.tensor([p]))
        self.eps = eps

    def forward(self, maps: torch.Tensor) -> torch.Tensor:
        # In float32 also under autocast: cubes overflow half precision.
        return _generalised_mean(maps.float(), self.p, self.eps, (-2, -1))


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
    """1 x 1 convolution and average pooling in a grid of `s1` rows and `s2` columns of cells."""

    inferred: ClassVar = {"in_channels": "channels"}

    def __init__(
        self, in_channels: Size, out_channels: Size = 512, s1: Size = 2, s2: Size = 2
    ) -> None:
        super().__init__(out_channels * s1 * s2)
        self.channels = nn.Conv2d(in_channels, out_channels, kernel_size=1)
        self.cells = nn.AdaptiveAvgPool2d((s1, s2))

    def forward(self, maps: torch.Tensor) -> torch.Tensor:
        return normalise_rows(self.cells(self.channels(maps)))
