"""Aggregators of pretrained backbones: VLAD (hard, soft), average pooling, GeM pooling.

VLAD (Jegou et al. 2010), as AnyLoc (RA-L 2023) defines it. For patches x (L2-normalised), centres
c_k and weights w of the patches in the clusters:

    hard:  w_qk = 1 for k = argmax_k <x_q, c_k / |c_k|>, the first of equals wins; else 0
    soft:  w_qk = softmax over k of temperature * <x_q, c_k / |c_k|>
    v_k      = sum over q of w_qk (x_q - c_k)             the centre is NOT normalised here
    v_k     <- v_k / |v_k|                                unused clusters stay 0
    row      = [v_0 ... v_{K-1}] / | . |                  cluster-major

Soft blocks hold the residuals to their own centre. AnyLoc's published code adds the residuals to
every centre to every block, which differs from its formula; this module follows the formula.

The sums are computed as sum(w x) - sum(w) c, so memory is O(batch x (patches x K + K x D)), never
patches x K x D. A patch whose feature is zero has no direction: its weight is 0 in every cluster. A
photo with only such patches has a zero row, which is similar to nothing. A photo with a non-finite
number in any feature has a row of NaN.

Average and GeM pooling need no vocabulary; the descriptor is as long as one local feature.

    AVG:  row_d = mean over patches of x_d
    GeM:  row_d = (mean over patches of max(x_d, eps)^p)^(1 / p)         p = 3, eps = 1e-6

and row <- row / |row|. GeM is the generalised mean of Radenovic, Tolias and Chum (TPAMI 2019,
"Fine-tuning CNN Image Retrieval with No Human Annotation", eq. 3 and 4) with the clamp of their
code: negative values count as eps. (AnyLoc's own GeM keeps the sign of the mean of cubes instead.)

Both means leave out patches whose feature is zero; if all are zero, the row is zero. Features have
to be finite: the clamp would hide some values that are not.
"""

from __future__ import annotations

import torch
from torch.nn.functional import normalize, one_hot


def assign_clusters(features: torch.Tensor, centres: torch.Tensor) -> torch.Tensor:
    """Return the int64 label (...) of the centre (K, D) most similar to each feature (..., D)."""
    return _cosines(features, centres).argmax(dim=-1)


@torch.inference_mode()
def vlad(features: torch.Tensor, centres: torch.Tensor) -> torch.Tensor:
    """Aggregate features by VLAD with hard assignment.

    Args:
        features: (B, patches, D) L2-normalised float32.
        centres: (K, D) cluster centres.

    Returns:
        (B, K * D) unit rows.
    """
    return _sum_residuals(features, centres, hard_assignment(features, centres))


@torch.inference_mode()
def soft_vlad(features: torch.Tensor, centres: torch.Tensor, temperature: float) -> torch.Tensor:
    """Aggregate features by VLAD with soft assignment: each patch counts in every cluster.

    Shapes as in `vlad`. As `temperature` grows, the assignment approaches the hard one; at 0, a
    patch counts equally in all clusters.
    """
    return _sum_residuals(features, centres, soft_assignment(features, centres, temperature))


def hard_assignment(features: torch.Tensor, centres: torch.Tensor) -> torch.Tensor:
    """Return weights (..., K): 1 for the cluster of a feature (..., D), else 0."""
    weights = one_hot(assign_clusters(features, centres), len(centres)).to(features.dtype)
    return weights * _is_nonzero(features)


def soft_assignment(
    features: torch.Tensor, centres: torch.Tensor, temperature: float
) -> torch.Tensor:
    """Return weights (..., K): the softmax over the centres (K, D) for each feature (..., D)."""
    weights = (temperature * _cosines(features, centres)).softmax(dim=-1)
    return weights * _is_nonzero(features)


def _is_nonzero(features: torch.Tensor) -> torch.Tensor:
    """(..., D) -> (..., 1) bool; False for patches whose feature is zero."""
    return (features != 0).any(dim=-1, keepdim=True)


def _cosines(features: torch.Tensor, centres: torch.Tensor) -> torch.Tensor:
    return features @ normalize(centres, dim=-1).T


def _sum_residuals(
    features: torch.Tensor, centres: torch.Tensor, weights: torch.Tensor
) -> torch.Tensor:
    """(B, patches, D), (K, D), (B, patches, K) -> (B, K * D)."""
    sums = weights.transpose(1, 2) @ features  # (B, K, D)
    shares = weights.sum(dim=1).unsqueeze(-1)  # (B, K, 1)
    blocks = normalize(sums - shares * centres, dim=-1)
    return normalize(blocks.flatten(1), dim=-1)


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
    nonzero = _is_nonzero(features)  # (B, patches, 1)
    powers = features.clamp(min=GEM_EPS) ** GEM_POWER * nonzero
    means = powers.sum(dim=1) / nonzero.sum(dim=1).clamp(min=1)
    return normalize(means ** (1 / GEM_POWER), dim=-1)
