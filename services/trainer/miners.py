"""Miners by name, with the settings of the predecessor's published runs.

A miner looks for the pairs or triplets of a batch that a loss is to learn from. All are
pytorch-metric-learning's, but for the angular one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from pytorch_metric_learning import miners
from pytorch_metric_learning.distances import CosineSimilarity, DotProductSimilarity
from pytorch_metric_learning.losses import FastAPLoss
from pytorch_metric_learning.utils import loss_and_miner_utils
from torch import nn

from services.trainer.losses import match_name

NO_MINER = "none"
MAX_BLOCK_VALUES = 1 << 22  # 16 MB of float32


class AngularMiner(nn.Module):
    """All triplets (a, p, n) with atan(|a - p| / (2 |n - (a + p) / 2|)) > angle: the angle
    at n in the triangle of Wang et al. 2017.

    The same triplets in the same order as `miners.AngularMiner`, which copies three rows for each
    of them; here the distances to the centre of each pair are taken, some pairs at a time.
    """

    def __init__(self, angle: float, max_block_values: int = MAX_BLOCK_VALUES) -> None:
        """`angle` in degrees; no intermediate result has more than `max_block_values` numbers,
        unless one pair's has."""
        super().__init__()
        self.tangent = math.tan(math.radians(angle))
        self.max_block_values = max_block_values

    @torch.no_grad()
    def forward(self, rows: torch.Tensor, labels: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """(B, D) unit rows, (B,) labels -> indices of anchors, positives and negatives."""
        a, p, _, _ = loss_and_miner_utils.get_all_pairs_indices(labels)
        at_once = max(1, self.max_block_values // max(rows.shape))
        found = []
        for anchors, positives in zip(a.split(at_once), p.split(at_once), strict=True):
            sides = (rows[anchors] - rows[positives]).norm(dim=1, keepdim=True)
            centres = (rows[anchors] + rows[positives]) / 2
            # By differences: products cancel where a negative is close to the centre.
            to_centre = torch.cdist(centres, rows, compute_mode="donot_use_mm_for_euclid_dist")
            wide = sides > 2 * self.tangent * to_centre
            wide &= labels[anchors].unsqueeze(1) != labels
            pair, negatives = torch.where(wide)
            found.append((anchors[pair], positives[pair], negatives))
        return tuple(torch.cat(part) for part in zip(*found, strict=True))


MINERS: dict[str, Callable[[float], nn.Module]] = {
    "MultiSimilarityMiner": lambda margin: miners.MultiSimilarityMiner(
        epsilon=margin, distance=CosineSimilarity()
    ),
    "UniformHistogramMiner": lambda _margin: miners.UniformHistogramMiner(
        num_bins=100, pos_per_bin=10, neg_per_bin=10
    ),
    "AngularMiner": lambda _margin: AngularMiner(angle=20),
    "BatchHardMiner": lambda _margin: miners.BatchHardMiner(),
    # The library's default: each photo's easiest positive, and its hardest negative beyond that.
    "BatchEasyHardMiner": lambda _margin: miners.BatchEasyHardMiner(),
    "TripletMarginMiner": lambda margin: miners.TripletMarginMiner(
        margin=margin, type_of_triplets="semihard"
    ),
    "PairMarginMiner": lambda _margin: miners.PairMarginMiner(
        pos_margin=0.7, neg_margin=0.3, distance=DotProductSimilarity()
    ),
}


def make_miner(name: str | None, margin: float = 0.1) -> nn.Module | None:
    """The miner: (B, D) float32 rows, (B,) labels -> indices in the batch, of pairs (a1, p, a2, n)
    or triplets (a, p, n). None for `none` or None: the loss takes all pairs.

    `name`: a key of MINERS, in capitals or not, with or without `Miner`; `margin` (cosine for
    MultiSimilarityMiner, distance for TripletMarginMiner) reaches those two alone, as it did in the
    predecessor. Unprocessable: `unknown_miner`.
    """
    if name is None or name.strip().lower() == NO_MINER:
        return None
    known = (*MINERS, NO_MINER)
    return MINERS[match_name(name, known, suffix="Miner", argument="miner_name")](margin)


def batch_accuracy(
    loss: nn.Module, miner: nn.Module | None, mined: Any, photos: int
) -> float | None:
    """The predecessor's `b_acc`: the share of a batch's photos that are no anchor of what was
    mined, because the network already tells their places apart.

    None where that says nothing: without a miner, with FastAP (for which mined pairs are weights,
    every photo is an anchor) and with the histogram miner (which samples, whatever is learnt).
    """
    if miner is None or isinstance(loss, FastAPLoss):
        return None
    if isinstance(miner, miners.UniformHistogramMiner):
        return None
    return 1.0 - len(torch.unique(mined[0])) / photos
