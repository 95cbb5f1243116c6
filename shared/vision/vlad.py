"""VLAD: hard assignment by cosine, residuals against the raw centres, intra-normalised.

For patches x (L2-normalised) and centres c_k (Jegou et al. 2010; AnyLoc, RA-L 2023):

    label(q) = argmax_k <x_q, c_k / |c_k|>                first best wins
    v_k      = sum over q with label k of (x_q - c_k)     the centre is NOT normalised here
    v_k     <- v_k / |v_k|                                unused clusters stay 0
    row      = [v_0 ... v_{K-1}] / | . |                  cluster-major

The sums are taken as sum(x) - count * c, so memory is O(batch x K x D), never patches x K x D.
"""

from __future__ import annotations

import torch
from torch.nn.functional import normalize, one_hot


def assign(features: torch.Tensor, centres: torch.Tensor) -> torch.Tensor:
    """(..., D) features and (K, D) centres -> (...) int64 labels of the most similar centre."""
    return (features @ normalize(centres, dim=-1).T).argmax(dim=-1)


@torch.inference_mode()
def vlad(features: torch.Tensor, centres: torch.Tensor) -> torch.Tensor:
    """(B, patches, D) L2-normalised float32 features, (K, D) centres -> (B, K * D) unit rows."""
    clusters = centres.shape[0]
    members = one_hot(assign(features, centres), clusters).to(features.dtype)  # (B, N, K)
    sums = members.transpose(1, 2) @ features  # (B, K, D)
    counts = members.sum(dim=1).unsqueeze(-1)  # (B, K, 1)
    blocks = normalize(sums - counts * centres, dim=-1)
    return normalize(blocks.flatten(1), dim=-1)
