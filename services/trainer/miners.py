"""Pair and triplet miners by name, with the settings of the published GSV-Cities runs.

A miner selects the informative pairs or triplets of a batch for the loss. All miners come from
pytorch-metric-learning except `AngularMiner`, which needs less memory than the library's.
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
from services.trainer.model_factory import make_own_module
from shared.descriptors.vpr_models.config import is_own_module

NO_MINER = "none"
MAX_BLOCK_VALUES = 1 << 22  # 16 MB of float32


class AngularMiner(nn.Module):
    """Selects all triplets (a, p, n) with atan(|a - p| / (2 |n - (a + p) / 2|)) > angle.

    This is the angle at n in the triangle of Wang et al. 2017. The result has the same triplets in
    the same order as `miners.AngularMiner`. The library's version copies three rows per triplet;
    this one computes the distances to the centre of each pair, in blocks of pairs.
    """

    def __init__(self, angle: float, max_block_values: int = MAX_BLOCK_VALUES) -> None:
        """Create the miner.

        Args:
            angle: minimum angle, in degrees.
            max_block_values: maximum number of values in an intermediate tensor; exceeded only
                if a single pair needs more.
        """
        super().__init__()
        self.tangent = math.tan(math.radians(angle))
        self.max_block_values = max_block_values

    @torch.no_grad()
    def forward(self, rows: torch.Tensor, labels: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Return the indices of anchors, positives and negatives, each (triplets,) int64.

        Args:
            rows: (B, D) L2-normalised embeddings.
            labels: (B,) place labels.
        """
        a, p, _, _ = loss_and_miner_utils.get_all_pairs_indices(labels)
        block_pairs = max(1, self.max_block_values // max(rows.shape))
        blocks = []
        for anchors, positives in zip(a.split(block_pairs), p.split(block_pairs), strict=True):
            sides = (rows[anchors] - rows[positives]).norm(dim=1, keepdim=True)
            centres = (rows[anchors] + rows[positives]) / 2
            # The matrix-product form loses precision where a negative is close to the centre.
            distances = torch.cdist(centres, rows, compute_mode="donot_use_mm_for_euclid_dist")
            selected = sides > 2 * self.tangent * distances
            selected &= labels[anchors].unsqueeze(1) != labels
            pair, negatives = torch.where(selected)
            blocks.append((anchors[pair], positives[pair], negatives))
        return tuple(torch.cat(part) for part in zip(*blocks, strict=True))


MINERS: dict[str, Callable[[float], nn.Module]] = {
    "MultiSimilarityMiner": lambda margin: miners.MultiSimilarityMiner(
        epsilon=margin, distance=CosineSimilarity()
    ),
    "UniformHistogramMiner": lambda _margin: miners.UniformHistogramMiner(
        num_bins=100, pos_per_bin=10, neg_per_bin=10
    ),
    "AngularMiner": lambda _margin: AngularMiner(angle=20),
    "BatchHardMiner": lambda _margin: miners.BatchHardMiner(),
    # Library default: each photo's easiest positive and hardest negative farther than it.
    "BatchEasyHardMiner": lambda _margin: miners.BatchEasyHardMiner(),
    "TripletMarginMiner": lambda margin: miners.TripletMarginMiner(
        margin=margin, type_of_triplets="semihard"
    ),
    "PairMarginMiner": lambda _margin: miners.PairMarginMiner(
        pos_margin=0.7, neg_margin=0.3, distance=DotProductSimilarity()
    ),
}


def make_miner(name: str | None, margin: float = 0.1) -> nn.Module | None:
    """Create a miner by name.

    The miner is called with (B, D) float32 embeddings and (B,) labels, and returns indices into
    the batch: pairs (a1, p, a2, n) or triplets (a, p, n).

    Args:
        name: a key of MINERS, in any case, with or without `Miner`; `package.module:Class`; `none`
            or None for no miner.
        margin: epsilon of MultiSimilarityMiner (cosine) or margin of TripletMarginMiner (distance);
            ignored by the other miners, as in the GSV-Cities code.

    Returns:
        The miner, or None: the loss then uses all pairs.

    Raises:
        Unprocessable: `unknown_miner`.
        InvalidRequest: `own_module_unfit`.
    """
    if name is None or name.strip().lower() == NO_MINER:
        return None
    if is_own_module(name):
        return make_own_module("miner_name", name)
    known = (*MINERS, NO_MINER)
    return MINERS[match_name(name, known, suffix="Miner", argument="miner_name")](margin)


def batch_accuracy(
    loss: nn.Module, miner: nn.Module | None, mined: Any, photos: int
) -> float | None:
    """Return `b_acc` of the GSV-Cities code: the share of photos without a mined pair or triplet.

    These are the photos whose places the network already distinguishes.

    Returns:
        A share from 0 to 1. None where it is not meaningful: without a miner, with FastAP (mined
        pairs are weights there, so every photo is an anchor), and with the histogram miner (which
        samples pairs independently of what was learned).
    """
    if miner is None or isinstance(loss, FastAPLoss):
        return None
    if isinstance(miner, miners.UniformHistogramMiner):
        return None
    return 1.0 - len(torch.unique(mined[0])) / photos
