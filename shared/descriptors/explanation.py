"""Where a similarity comes from: what each cluster and each patch of the query adds to it.

The similarity of a query's row r and a candidate's row d is <r, d>, and r is a sum over patches:

    VLAD:  r_k = sum over q of w_qk (x_q - c_k) / (n_k n)
           n_k = | sum over q of w_qk (x_q - c_k) |,   n = | [v_0 ... v_{K-1}] |
    mean:  r   = sum over q of x_q / (Q |mean|)

(the symbols of `shared.descriptors.aggregation`; Q patches). So patch q has the share

    VLAD:  sum over k of w_qk <x_q - c_k, d_k> / (n_k n)      and cluster k  sum over q of the same
    mean:  <x_q, d> / (Q |mean|)

and either kind of share adds up to the similarity. With word weights u (`shared.word_weights`) a
cluster's and each of its patches' shares are u_k / |[u_0 r_0 ... u_{K-1} r_{K-1}]| times as large,
and add up to the weighted score. In float64: the sums of many small shares of both signs are to
agree with a cosine that was computed in one piece.

Shares of patches as a picture that can be laid over the photo.
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

from shared.descriptors.aggregation import hard_assignment, soft_assignment
from shared.descriptors.vocabulary import ClusterCentres
from shared.extractor_config.configs import ExtractorConfig

Shares = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class SimilarityShares:
    """The shares of one similarity."""

    patches: Shares
    """(Q,), in the order of the query's patches."""
    clusters: Shares | None
    """(K,); None without a vocabulary."""


def explain_similarities(
    recipe: ExtractorConfig,
    features: torch.Tensor,
    centres: ClusterCentres | None,
    rows: NDArray[np.float32],
    word_weights: Sequence[float] = (),
) -> list[SimilarityShares]:
    """The shares of each candidate's similarity to the query.

    `features` are the query's, (Q, D); `rows` the candidates' descriptors, (n, dimension), as they
    were stored; `word_weights`, (K,), are for VLAD. ValueError for an aggregator that is no sum
    (`check_explainable` says so before).
    """
    x = features.double()
    match recipe.aggregator:
        case "avg":
            return [
                SimilarityShares(share, None) for share in _mean_shares(x, torch.from_numpy(rows))
            ]
        case "vlad" | "soft-vlad":
            assert centres is not None
            c = torch.from_numpy(centres.array)
            # In the precision in which the descriptor was made: a tie goes to the same cluster.
            weights = (
                hard_assignment(features, c)
                if recipe.aggregator == "vlad"
                else soft_assignment(features, c, recipe.temperature)
            )
            words = torch.tensor(word_weights or [1.0] * len(c), dtype=torch.float64)
            return _vlad_shares(x, c.double(), weights.double(), words, torch.from_numpy(rows))
        case other:
            raise ValueError(f"a descriptor of {other!r} is no sum over patches")


def _mean_shares(x: torch.Tensor, rows: torch.Tensor) -> list[Shares]:
    length = x.mean(dim=0).norm().clamp(min=torch.finfo(torch.float32).tiny)
    return [(x @ row.double() / (len(x) * length)).numpy() for row in rows]


def _vlad_shares(
    x: torch.Tensor,
    centres: torch.Tensor,
    weights: torch.Tensor,
    words: torch.Tensor,
    rows: torch.Tensor,
) -> list[SimilarityShares]:
    """(Q, D), (K, D), (Q, K), (K,), (n, K * D)."""
    sums = weights.T @ x - weights.sum(dim=0).unsqueeze(-1) * centres
    lengths = sums.norm(dim=1)
    # Without weights this is |[v_0 ... v_{K-1}]|, and with them the rest of either norm cancels.
    whole = (words.unsqueeze(-1) * normalize(sums, dim=-1)).norm()
    used = lengths > 0
    scale = torch.where(used, words / (lengths * whole), 0)  # (K,); an unused cluster has no share
    found = []
    for row in rows:
        blocks = row.double().reshape(centres.shape)
        along = x @ blocks.T - (centres * blocks).sum(dim=1)  # (Q, K): <x_q - c_k, d_k>
        shares = weights * along * scale
        found.append(SimilarityShares(shares.sum(dim=1).numpy(), shares.sum(dim=0).numpy()))
    return found


# Told apart by every kind of sight.
POSITIVE_COLOUR = (230, 97, 1)  # orange: the patch speaks for the match
NEGATIVE_COLOUR = (94, 60, 153)  # violet: it speaks against it


def draw_overlay(shares: NDArray[np.float64]) -> tuple[str, float]:
    """(rows, columns) shares -> a PNG as a data URI, one pixel for each patch, and the full share.

    The colour says for or against, the opacity |share| / full share: where nothing is added, the
    picture is transparent. The full share is the strongest one of either sign; 0 if all are 0.
    """
    strength = np.abs(shares)
    full = float(strength.max())
    pixels = np.zeros((*shares.shape, 4), np.uint8)
    pixels[..., :3] = np.where((shares >= 0)[..., np.newaxis], POSITIVE_COLOUR, NEGATIVE_COLOUR)
    if full > 0:
        pixels[..., 3] = np.round(255 * strength / full)
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG", optimize=True)
    return f"data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}", full
