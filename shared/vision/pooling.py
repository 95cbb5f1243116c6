"""Aggregators without a vocabulary: a descriptor is as long as one local feature.

    AVG:  row_d = mean over patches of x_d
    GeM:  row_d = (mean over patches of max(x_d, eps)^p)^(1 / p)         p = 3, eps = 1e-6

and row <- row / |row|. GeM is the generalised mean of Radenovic, Tolias and Chum (TPAMI 2019,
"Fine-tuning CNN Image Retrieval with No Human Annotation", eq. 3 and 4) with the clamp of their
code: what is negative counts as eps. (AnyLoc's own GeM instead keeps the sign of the mean of
cubes.)

A patch whose feature is zero is left out of both means; of nothing but such patches, the row is
zero. Features have to be finite: the clamp would hide some of those that are not.
"""

from __future__ import annotations

import torch
from torch.nn.functional import normalize

GEM_POWER = 3.0
GEM_EPS = 1e-6


@torch.inference_mode()
def average_pooling(features: torch.Tensor) -> torch.Tensor:
    """(B, patches, D) float32 -> (B, D) unit rows. Zero patches change the length alone."""
    return normalize(features.mean(dim=1), dim=-1)


@torch.inference_mode()
def gem_pooling(features: torch.Tensor) -> torch.Tensor:
    """(B, patches, D) float32 -> (B, D) unit rows."""
    there = (features != 0).any(dim=-1, keepdim=True)  # (B, patches, 1)
    powers = features.clamp(min=GEM_EPS) ** GEM_POWER * there
    means = powers.sum(dim=1) / there.sum(dim=1).clamp(min=1)
    return normalize(means ** (1 / GEM_POWER), dim=-1)
