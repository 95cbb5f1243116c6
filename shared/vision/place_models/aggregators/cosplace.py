"""CosPlace's head (Berton, Masone and Caputo 2022, "Rethinking Visual Geo-localization").

y   = x / |x| over the channels, at each position
row = W GeM(y) + b              GeM with a learnt p, see `pooling`
row <- row / |row|
"""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import nn
from torch.nn.functional import normalize

from shared.vision.place_models.aggregators.base import Aggregator, Size, normalise_rows
from shared.vision.place_models.aggregators.pooling import (
    GEM_EPS,
    GEM_POWER,
    GeneralizedMeanPooling,
)


class CosPlace(Aggregator):
    inferred: ClassVar = {"in_dim": "channels"}

    def __init__(self, in_dim: Size, out_dim: Size = 512) -> None:
        super().__init__(out_dim)
        self.pool = GeneralizedMeanPooling(GEM_POWER, GEM_EPS)
        self.linear = nn.Linear(in_dim, out_dim)

    def forward(self, maps: torch.Tensor) -> torch.Tensor:
        return normalise_rows(self.linear(self.pool(normalize(maps, dim=1))))
