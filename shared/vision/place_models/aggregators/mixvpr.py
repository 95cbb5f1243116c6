"""MixVPR (Ali-bey, Chaib-draa and Giguere 2023, "MixVPR: Feature Mixing for Visual Place
Recognition", eq. 2 to 5).

    x   = the map with its h x w positions as one axis: (C, hw)
    x  <- x + W2 relu(W1 LayerNorm(x))          along hw, `mix_depth` times
    y   = Wc x                                  along the channels, to `out_channels`
    z   = Wr y                                  along hw, to `out_rows`
    row = z / |z|                               channel-major

All maps have the one size that its layers were made for.
"""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import nn

from shared.vision.place_models.aggregators.base import (
    Aggregator,
    Layers,
    Positive,
    Size,
    normalise_rows,
)


class FeatureMixer(nn.Module):
    def __init__(self, positions: int, hidden: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(positions)
        self.widen = nn.Linear(positions, hidden)
        self.narrow = nn.Linear(hidden, positions)
        for linear in (self.widen, self.narrow):
            nn.init.trunc_normal_(linear.weight, std=0.02)
            nn.init.zeros_(linear.bias)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        mixed: torch.Tensor = self.narrow(self.widen(self.norm(x)).relu())
        return x + mixed


class MixVPR(Aggregator):
    inferred: ClassVar = {"in_channels": "channels", "in_h": "height", "in_w": "width"}

    def __init__(
        self,
        in_channels: Size,
        in_h: Size,
        in_w: Size,
        out_channels: Size = 128,
        mix_depth: Layers = 1,
        mlp_ratio: Positive = 1.0,
        out_rows: Size = 4,
    ) -> None:
        super().__init__(out_channels * out_rows)
        self.size = (in_h, in_w)
        positions = in_h * in_w
        hidden = max(1, int(positions * mlp_ratio))
        self.mixers = nn.Sequential(*(FeatureMixer(positions, hidden) for _ in range(mix_depth)))
        self.channels = nn.Linear(in_channels, out_channels)
        self.rows = nn.Linear(positions, out_rows)

    def forward(self, maps: torch.Tensor) -> torch.Tensor:
        mixed = self.mixers(maps.flatten(2))  # (B, C, hw)
        narrowed = self.channels(mixed.transpose(1, 2)).transpose(1, 2)
        return normalise_rows(self.rows(narrowed))

    def refusal(self, height: int, width: int) -> str | None:
        if (height, width) == self.size:
            return None
        return (
            f"their map is {height} x {width}, and its layers take {self.size[0]} x "
            f"{self.size[1]} only"
        )
