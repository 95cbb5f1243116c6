"""Explanations of similarities: the share of each cluster and of each patch, and an image overlay.

The similarity of a query's row r and a candidate's row d is <r, d>, and r is a sum over patches:

    VLAD:  r_k = sum over q of w_qk (x_q - c_k) / (n_k n)
           n_k = | sum over q of w_qk (x_q - c_k) |,   n = | [v_0 ... v_{K-1}] |
    mean:  r   = sum over q of x_q / (Q |mean|)

(the symbols of `shared.descriptors.aggregators.clustering`; Q patches). So the share of patch q is

    VLAD:  sum over k of w_qk <x_q - c_k, d_k> / (n_k n)   cluster k: sum over q of the same
    mean:  <x_q, d> / (Q |mean|)

and either kind of share adds up to the similarity. With word weights u (`shared.word_weights`) the
shares of a cluster and of its patches are multiplied by u_k / |[u_0 r_0 ... u_{K-1} r_{K-1}]| and
add up to the weighted score. Computed in float64, so that sums of many small shares of both signs
agree with a cosine that was computed at once.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch.nn.functional import normalize

from shared.descriptors.aggregators.clustering import hard_assignment, soft_assignment
from shared.descriptors.vocabulary import ClusterCentres
from shared.extractor_config.configs import ExtractorConfig

Shares = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class SimilarityShares:
    """The shares of patches and clusters in one similarity."""

    patches: Shares
    """(Q,) shares, in the order of the query's patches."""
    clusters: Shares | None
    """(K,) shares; None without a vocabulary."""


def explain_similarities(
    config: ExtractorConfig,
    features: torch.Tensor,
    centres: ClusterCentres | None,
    rows: NDArray[np.float32],
    word_weights: Sequence[float] = (),
) -> list[SimilarityShares]:
    """Split each candidate's similarity to the query into shares of patches and clusters.

    Args:
        features: (Q, D) local features of the query.
        centres: The vocabulary; required for VLAD.
        rows: (n, dimension) descriptors of the candidates, as they are stored.
        word_weights: (K,) word weights for VLAD; empty for none.

    Raises:
        ValueError: The aggregator is not a sum over patches; call `check_explainable` first.
    """
    x = features.double()
    match config.aggregator:
        case "avg":
            return [
                SimilarityShares(share, None) for share in _mean_shares(x, torch.from_numpy(rows))
            ]
        case "vlad" | "soft-vlad":
            assert centres is not None
            c = torch.from_numpy(centres.array)
            # In the precision of the descriptor, so that ties go to the same cluster.
            weights = (
                hard_assignment(features, c)
                if config.aggregator == "vlad"
                else soft_assignment(features, c, config.temperature)
            )
            cluster_weights = torch.tensor(word_weights or [1.0] * len(c), dtype=torch.float64)
            return _vlad_shares(
                x, c.double(), weights.double(), cluster_weights, torch.from_numpy(rows)
            )
        case other:
            raise ValueError(f"a descriptor of {other!r} is not a sum over patches")


def _mean_shares(x: torch.Tensor, rows: torch.Tensor) -> list[Shares]:
    length = x.mean(dim=0).norm().clamp(min=torch.finfo(torch.float32).tiny)
    return [(x @ row.double() / (len(x) * length)).numpy() for row in rows]


def _vlad_shares(
    x: torch.Tensor,
    centres: torch.Tensor,
    weights: torch.Tensor,
    cluster_weights: torch.Tensor,
    rows: torch.Tensor,
) -> list[SimilarityShares]:
    """Shapes: x (Q, D), centres (K, D), weights (Q, K), cluster_weights (K,), rows (n, K * D)."""
    sums = weights.T @ x - weights.sum(dim=0).unsqueeze(-1) * centres
    lengths = sums.norm(dim=1)
    # Without weights this is |[v_0 ... v_{K-1}]|, and with them the rest of either norm cancels.
    total_length = (cluster_weights.unsqueeze(-1) * normalize(sums, dim=-1)).norm()
    used = lengths > 0
    # (K,); an unused cluster has no share.
    scale = torch.where(used, cluster_weights / (lengths * total_length), 0)
    results = []
    for row in rows:
        blocks = row.double().reshape(centres.shape)
        projections = x @ blocks.T - (centres * blocks).sum(dim=1)  # (Q, K): <x_q - c_k, d_k>
        shares = weights * projections * scale
        results.append(SimilarityShares(shares.sum(dim=1).numpy(), shares.sum(dim=0).numpy()))
    return results


# Distinguishable with any colour vision deficiency.
POSITIVE_COLOUR = (230, 97, 1)  # orange: the patch adds to the similarity
NEGATIVE_COLOUR = (94, 60, 153)  # violet: it subtracts from it


def draw_overlay(shares: NDArray[np.float64]) -> tuple[str, float]:
    """Render shares as an image overlay.

    The colour is the share's sign, the opacity is |share| / maximum |share|.

    Args:
        shares: (rows, columns) shares of the patches.

    Returns:
        A PNG as a data URI, one pixel per patch, and the maximum |share| (0 if all are 0).
    """
    strength = np.abs(shares)
    max_share = float(strength.max())
    pixels = np.zeros((*shares.shape, 4), np.uint8)
    pixels[..., :3] = np.where((shares >= 0)[..., np.newaxis], POSITIVE_COLOUR, NEGATIVE_COLOUR)
    if max_share > 0:
        pixels[..., 3] = np.round(255 * strength / max_share)
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG", optimize=True)
    return f"data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}", max_share
