"""Aggregators by clusters: VLAD (hard, soft), NetVLAD and SALAD.

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

NetVLAD (Arandjelovic et al. 2016, "NetVLAD: CNN Architecture for Weakly Supervised Place
Recognition", eq. 1 to 4):

    x_i   = local feature of position i, L2-normalised
    a_ik  = softmax over k of w_k . x_i + b_k
    V_k   = sum over i of a_ik (x_i - c_k)
    V_k  <- V_k / |V_k|
    row   = [V_0 ... V_{K-1}] / | . |            cluster-major

w, b and c are separate parameters. They are initialised as in the paper, w_k = 2 alpha c_k and
b_k = -alpha |c_k|^2, but around random unit vectors c_k: with alpha 100, the best cluster of a
feature outweighs the second by about 100 in 256 channels, which is the paper's rule for alpha.

SALAD (Izquierdo and Civera 2024, "Optimal Transport Aggregation for Visual Place Recognition",
section 3):

    s_ik  = score of local feature i in cluster k, by an MLP; one learnt number for the dustbin
    P     = Sinkhorn's plan for exp(s): every feature has a mass of 1, every cluster a capacity of
            1, the dustbin takes the rest
    V_k   = sum over i of P_ik f_i              f: the features, by an MLP to `cluster_dim` numbers
    g     = the global token, by an MLP to `token_dim` numbers
    row   = [g / |g|, V_0 / |V_0|, V_1 / |V_1|, ...] / | . |    cluster-major, K x cluster_dim

The authors' code orders the same numbers as cluster_dim x K (`published_order`). MegaLoc (Berton
and Masone 2025) projects the row linearly to `out_dim` numbers, and normalises it again.

The paper's backbone is DINOv2, whose class token is the global token. For a network without one, it
is the mean of the map over its positions. The map needs more positions than there are clusters;
otherwise nothing is left for the dustbin.
"""

from __future__ import annotations

import math
import operator
from typing import Annotated, ClassVar

import torch
from pydantic import Field
from torch import nn
from torch.nn.functional import normalize, one_hot

from shared.descriptors.aggregators.base import Aggregator, Positive, Size, normalise_rows


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


class NetVLAD(Aggregator):
    """Soft-assigned residuals to learnt cluster centres."""

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
        return _sum_residuals(features, self.centres, shares)


HIDDEN_WIDTH = 512  # channels between the two layers of each MLP
SINKHORN_ITERATIONS = 3
DUSTBIN_SCORE = 1.0  # initial value

Share = Annotated[float, Field(ge=0, lt=1)]
# Left out of the stored configuration if false, so that fingerprints of older models remain.
StoredIfTrue = Annotated[bool, Field(exclude_if=operator.not_)]
StoredIfGiven = Annotated[Size | None, Field(exclude_if=operator.not_)]


class SALAD(Aggregator):
    """Features assigned to clusters by optimal transport, and a global token."""

    inferred: ClassVar = {"in_channels": "channels"}
    takes_token: ClassVar = True

    def __init__(
        self,
        in_channels: Size,
        num_clusters: Size = 64,
        cluster_dim: Size = 128,
        token_dim: Size = 256,
        dropout: Share = 0.3,
        published_order: StoredIfTrue = False,
        out_dim: StoredIfGiven = None,
    ) -> None:
        width = token_dim + num_clusters * cluster_dim
        super().__init__(out_dim or width)
        self.projection = nn.Linear(width, out_dim) if out_dim else nn.Identity()
        self.published_order = published_order
        self.num_clusters = num_clusters
        self.features = _pointwise_mlp(in_channels, cluster_dim, dropout)
        self.scores = _pointwise_mlp(in_channels, num_clusters, dropout)
        self.token = nn.Sequential(
            nn.Linear(in_channels, HIDDEN_WIDTH), nn.ReLU(), nn.Linear(HIDDEN_WIDTH, token_dim)
        )
        self.dustbin = nn.Parameter(torch.tensor(DUSTBIN_SCORE))

    def forward(self, maps: torch.Tensor, token: torch.Tensor | None) -> torch.Tensor:
        features = self.features(maps).flatten(2).float()  # (B, cluster_dim, hw)
        scores = self.scores(maps).flatten(2).float()  # (B, K, hw)
        plan = optimal_transport(scores, self.dustbin)
        clusters = normalize(plan @ features.transpose(1, 2), dim=-1)  # (B, K, cluster_dim)
        if self.published_order:
            clusters = clusters.transpose(1, 2)
        if token is None:
            token = maps.mean(dim=(-2, -1))
        global_token = normalize(self.token(token).float(), dim=-1)
        rows = normalise_rows(torch.cat([global_token, clusters.flatten(1)], dim=1))
        return normalise_rows(self.projection(rows))

    def refusal(self, height: int, width: int) -> str | None:
        if height * width > self.num_clusters:
            return None
        return (
            f"their map has {height} x {width} positions, but it needs more positions than its "
            f"{self.num_clusters} clusters (num_clusters)"
        )


def optimal_transport(scores: torch.Tensor, dustbin: torch.Tensor) -> torch.Tensor:
    """Compute the transport plan of features to clusters by log-domain Sinkhorn iterations.

    The masses are 1 for a cluster, n - K for the dustbin and 1 for a feature; after a finite number
    of iterations those of the features are exact, the others approximate.

    Args:
        scores: (B, K, n) float32 scores of n features in K clusters.
        dustbin: The dustbin's score, a scalar.

    Returns:
        (B, K, n) mass of each feature in each cluster.
    """
    batch, clusters, positions = scores.shape
    extended = torch.cat([scores, dustbin.float().expand(batch, 1, positions)], dim=1)
    log_masses = scores.new_zeros(clusters + 1)
    log_masses[-1] = math.log(positions - clusters)
    log_v = scores.new_zeros(batch, 1, positions)
    for _ in range(SINKHORN_ITERATIONS):
        log_u = log_masses.view(1, -1, 1) - (extended + log_v).logsumexp(dim=2, keepdim=True)
        log_v = -(extended + log_u).logsumexp(dim=1, keepdim=True)
    return (extended + log_u + log_v).exp()[:, :clusters]


def _pointwise_mlp(channels: int, out: int, dropout: float) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(channels, HIDDEN_WIDTH, kernel_size=1),
        nn.Dropout(dropout),
        nn.ReLU(),
        nn.Conv2d(HIDDEN_WIDTH, out, kernel_size=1),
    )
