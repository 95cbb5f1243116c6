"""NetVLAD (Arandjelovic et al. 2016, "NetVLAD: CNN Architecture for Weakly Supervised Place
Recognition", eq. 1 to 4).

    x_i   = local feature of position i, L2-normalised
    a_ik  = softmax over k of w_k . x_i + b_k
    V_k   = sum over i of a_ik (x_i - c_k)
    V_k  <- V_k / |V_k|
    row   = [V_0 ... V_{K-1}] / | . |            cluster-major

w, b and c are learnt apart. They begin as the paper has them, w_k = 2 alpha c_k and b_k = -alpha
|c_k|^2, but around random unit vectors c_k: with alpha 100, the best cluster of a feature then
outweighs the second by about 100 in 256 channels, which is the paper's rule for alpha.
"""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import nn
from torch.nn.functional import normalize

from shared.vision.place_models.aggregators.base import Aggregator, Positive, Size, normalise_rows


class NetVLAD(Aggregator):
    inferred: ClassVar = {"in_channels": "channels"}

    def __init__(self, in_channels: Size, clusters: Size = 64, alpha: Positive = 100.0) -> None:
        super().__init__(clusters * in_channels)
        centres = normalize(torch.randn(clusters, in_channels), dim=1)
        self.centres = nn.Parameter(centres)
        self.weight = nn.Parameter(2 * alpha * centres)
        self.bias = nn.Parameter(-alpha * centres.square().sum(dim=1))

    def forward(self, maps: torch.Tensor) -> torch.Tensor:
        features = normalize(maps.flatten(2).transpose(1, 2).float(), dim=-1)  # (B, hw, C)
        shares = (features @ self.weight.T + self.bias).softmax(dim=-1)  # (B, hw, K)
        # Sums apart, so that no (B, hw, K, C) is needed.
        sums = shares.transpose(1, 2) @ features
        residuals = sums - shares.sum(dim=1).unsqueeze(-1) * self.centres
        return normalise_rows(normalize(residuals, dim=-1))
