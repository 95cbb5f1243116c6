"""Aggregators by mixing of positions: MixVPR and BoQ.

MixVPR (Ali-bey, Chaib-draa and Giguere 2023, "MixVPR: Feature Mixing for Visual Place Recognition",
eq. 2 to 5):

    x   = the map with its h x w positions as one axis: (C, hw)
    x  <- x + W2 relu(W1 LayerNorm(x))          along hw, `mix_depth` times
    y   = Wc x                                  along the channels, to `out_channels`
    z   = Wr y                                  along hw, to `out_rows`
    row = z / |z|                               channel-major

All maps must have the size that the layers were built for.

BoQ (Ali-bey, Chaib-draa and Giguere 2024, "BoQ: A Place is Worth a Bag of Learnable Queries",
section 3):

    x_0   = LayerNorm of a 3 x 3 convolution of the map to `proj_channels`, position by position
    x_l   = Encoder_l(x_{l-1})                  one transformer encoder layer
    q_l   = LayerNorm(Q_l + SelfAttention(Q_l))     Q_l: learnt queries, the same for all photos
    o_l   = LayerNorm(CrossAttention(q_l, x_l))     keys and values are the positions
    row   = W [o_1, o_2, ...] along the queries of all blocks, to `row_dim` numbers a channel
    row  <- row / |row|                         channel-major

The published networks have two blocks of 64 queries.
"""

from __future__ import annotations

from typing import Annotated, ClassVar

import torch
from pydantic import Field
from torch import nn

from shared.descriptors.aggregators.base import Aggregator, Layers, Positive, Size, normalise_rows


class _FeatureMixer(nn.Module):
    """Residual MLP along the positions of a (B, C, hw) map."""

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
    """Feature mixing along positions, then projections of channels and positions."""

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
        self.mixers = nn.Sequential(*(_FeatureMixer(positions, hidden) for _ in range(mix_depth)))
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
            f"their map is {height} x {width}, but its layers only take {self.size[0]} x "
            f"{self.size[1]}"
        )


HEAD_WIDTH = 64  # channels of one attention head
FEEDFORWARD_FACTOR = 4  # of an encoder layer's MLP


class _BoqBlock(nn.Module):
    """One encoder layer and the cross-attention of its learnt queries."""

    def __init__(self, width: int, queries: int) -> None:
        super().__init__()
        heads = width // HEAD_WIDTH
        self.encoder = nn.TransformerEncoderLayer(
            width, heads, dim_feedforward=FEEDFORWARD_FACTOR * width, dropout=0.0, batch_first=True
        )
        self.queries = nn.Parameter(torch.randn(1, queries, width))
        self.among_queries = nn.MultiheadAttention(width, heads, batch_first=True)
        self.norm_queries = nn.LayerNorm(width)
        self.to_positions = nn.MultiheadAttention(width, heads, batch_first=True)
        self.norm_out = nn.LayerNorm(width)

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the encoded positions (B, hw, width) and the outputs (B, queries, width)."""
        x = self.encoder(x)
        attended, _ = self.among_queries(
            self.queries, self.queries, self.queries, need_weights=False
        )
        queries = self.norm_queries(self.queries + attended).expand(len(x), -1, -1)
        out, _ = self.to_positions(queries, x, x, need_weights=False)
        return x, self.norm_out(out)


class BoQ(Aggregator):
    """Cross-attention of learnt queries to the positions of the map."""

    inferred: ClassVar = {"in_channels": "channels"}

    def __init__(
        self,
        in_channels: Size,
        proj_channels: Annotated[int, Field(ge=HEAD_WIDTH, multiple_of=HEAD_WIDTH)] = 512,
        num_queries: Size = 64,
        num_layers: Layers = 2,
        row_dim: Size = 32,
    ) -> None:
        super().__init__(proj_channels * row_dim)
        self.project = nn.Conv2d(in_channels, proj_channels, kernel_size=3, padding=1)
        self.norm = nn.LayerNorm(proj_channels)
        self.blocks = nn.ModuleList(
            _BoqBlock(proj_channels, num_queries) for _ in range(num_layers)
        )
        self.rows = nn.Linear(num_layers * num_queries, row_dim)

    def forward(self, maps: torch.Tensor) -> torch.Tensor:
        x = self.norm(self.project(maps).flatten(2).transpose(1, 2))  # (B, hw, width)
        outputs = []
        for block in self.blocks:
            x, out = block(x)
            outputs.append(out)
        return normalise_rows(self.rows(torch.cat(outputs, dim=1).transpose(1, 2)))
