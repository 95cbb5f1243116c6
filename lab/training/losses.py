"""Metric-learning losses and miners by name, with the settings of the published GSV-Cities runs.

A miner selects the informative pairs or triplets of a batch for the loss. All come from
pytorch-metric-learning. AngularLoss, NTXentLoss and AngularMiner are reimplemented with equal
results and less memory: a miner may find hundreds of thousands of triplets in 400 photos, for which
the library's versions allocate gigabytes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from pytorch_metric_learning import losses, miners
from pytorch_metric_learning.distances import CosineSimilarity, DotProductSimilarity
from pytorch_metric_learning.losses import FastAPLoss
from pytorch_metric_learning.utils import loss_and_miner_utils
from torch import nn
from torch.nn.functional import softplus

from lab.training.model_factory import make_own_module
from shared.descriptors.vpr_models.config import is_own_module
from shared.errors import Unprocessable


def _match_name(name: str, known: Sequence[str], *, suffix: str, argument: str) -> str:
    """Return the known name that equals `name`, ignoring case and the suffix, or raise an error."""
    key = name.strip().lower().removesuffix(suffix.lower())
    for candidate in known:
        if candidate.lower().removesuffix(suffix.lower()) == key:
            return candidate
    raise Unprocessable(
        f"unknown_{suffix.lower()}",
        f"There is no {suffix.lower()} {name!r}. Known: {', '.join(known)} ({argument}).",
    )


class AngularLoss(losses.AngularLoss):  # type: ignore[misc]
    """Angular loss of Wang et al. 2017 (ICCV, "Deep Metric Learning with Angular Loss").

    Mean over the pairs (a, p) of log(1 + sum over the batch's photos n of other places of
    exp(4 tan^2(alpha) (a + p).n - 2 (1 + tan^2(alpha)) a.p)). A pair that occurs in several
    triplets is computed once and weighted by its number of occurrences.
    """

    def compute_loss(
        self, embeddings: Any, labels: Any, indices_tuple: Any, ref_emb: Any, ref_labels: Any
    ) -> dict[str, Any]:
        a1, p, a2, n = loss_and_miner_utils.convert_to_pairs(indices_tuple, labels, ref_labels)
        if not len(a1) or not len(a2):
            return dict(self.zero_losses())
        (anchors, positives), pair_index = torch.unique(
            torch.stack([a1, p]), dim=1, return_inverse=True
        )
        result: dict[str, Any] = super().compute_loss(
            embeddings, labels, (anchors, positives, a2, n), ref_emb, ref_labels
        )
        result["loss"] |= {"losses": result["loss"]["losses"][pair_index], "indices": (a1, p)}
        return result


class NTXentLoss(losses.NTXentLoss):  # type: ignore[misc]
    """Normalised temperature-scaled cross entropy (InfoNCE).

    van den Oord et al. 2018; Chen et al. 2020 (SimCLR) introduced the name NT-Xent.

    Mean over the pairs (a, p) of -log(e^(s_ap / t) / (e^(s_ap / t) + sum over the negatives n of a
    of e^(s_an / t))), with s the cosine similarity and t the temperature. The sum over an anchor's
    negatives is shared by all of its pairs and computed once.
    """

    def _compute_loss(self, pos_pairs: Any, neg_pairs: Any, indices_tuple: Any) -> dict[str, Any]:
        a1, p, a2, _ = indices_tuple
        if not len(a1) or not len(a2):
            return dict(self.zero_losses())
        positives, negatives = pos_pairs / self.temperature, neg_pairs / self.temperature
        anchors = int(torch.max(a1.max(), a2.max())) + 1
        with torch.no_grad():
            largest = negatives.new_zeros(anchors)
            largest.scatter_reduce_(0, a2, negatives, "amax", include_self=False)
        sums = negatives.new_zeros(anchors).index_add(0, a2, (negatives - largest[a2]).exp())
        has_negatives = sums > 0
        # Without negatives the loss is 0; log(1) instead of log(0) avoids a NaN gradient.
        log_sums = largest + torch.where(has_negatives, sums, 1.0).log()
        pair_losses = torch.where(has_negatives[a1], softplus(log_sums[a1] - positives), 0.0)
        return {"loss": {"losses": pair_losses, "indices": (a1, p), "reduction_type": "pos_pair"}}


LOSSES: dict[str, Callable[[], nn.Module]] = {
    "MultiSimilarityLoss": lambda: losses.MultiSimilarityLoss(
        alpha=1.0, beta=50, base=0.0, distance=DotProductSimilarity()
    ),
    "AngularLoss": lambda: AngularLoss(alpha=40),
    "TripletMarginLoss": lambda: losses.TripletMarginLoss(
        margin=0.1, swap=False, smooth_loss=False, triplets_per_anchor="all"
    ),
    "FastAPLoss": lambda: losses.FastAPLoss(num_bins=30),
    "NTXentLoss": lambda: NTXentLoss(temperature=0.07),
    "SupConLoss": lambda: losses.SupConLoss(temperature=0.07),
    "CircleLoss": lambda: losses.CircleLoss(m=0.4, gamma=80),
    "ContrastiveLoss": lambda: losses.ContrastiveLoss(pos_margin=0, neg_margin=1),
}


def make_loss(name: str) -> nn.Module:
    """Create a loss: a key of LOSSES, in any case, also without `Loss`; or `package.module:Class`.

    It is called with (B, D) float32 embeddings, (B,) labels, and the indices that a miner returned;
    None uses all pairs of the batch. Raises Unprocessable (`unknown_loss`), InvalidRequest
    (`own_module_unusable`).
    """
    if is_own_module(name):
        return make_own_module("loss_name", name)
    return LOSSES[_match_name(name, tuple(LOSSES), suffix="Loss", argument="loss_name")]()


NO_MINER = "none"
MAX_BLOCK_VALUES = 1 << 22  # 16 MB of float32


class AngularMiner(nn.Module):
    """Selects all triplets (a, p, n) with atan(|a - p| / (2 |n - (a + p) / 2|)) > angle.

    This is the angle at n in the triangle of Wang et al. 2017. The result has the same triplets in
    the same order as `miners.AngularMiner`. The library's version copies three rows per triplet;
    this one computes the distances to the centre of each pair, in blocks of pairs.
    """

    def __init__(self, angle: float, max_block_values: int = MAX_BLOCK_VALUES) -> None:
        """Create the miner with a minimum angle, in degrees.

        An intermediate tensor exceeds `max_block_values` only if a single pair needs more.
        """
        super().__init__()
        self.tangent = math.tan(math.radians(angle))
        self.max_block_values = max_block_values

    @torch.no_grad()
    def forward(self, rows: torch.Tensor, labels: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Return the (triplets,) int64 indices of anchors, positives and negatives.

        `rows` are (B, D) L2-normalised embeddings, `labels` (B,) place labels.
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
    """Create a miner: a key of MINERS in any case, also without `Miner`; or `package.module:Class`.

    It is called with (B, D) float32 embeddings and (B,) labels, and returns indices into the batch:
    pairs (a1, p, a2, n) or triplets (a, p, n). With `none` or None, the loss uses all pairs.
    `margin` is the epsilon of MultiSimilarityMiner (cosine) or the margin of TripletMarginMiner
    (distance); the other miners ignore it, as in the GSV-Cities code.

    Raises Unprocessable (`unknown_miner`), InvalidRequest (`own_module_unusable`).
    """
    if name is None or name.strip().lower() == NO_MINER:
        return None
    if is_own_module(name):
        return make_own_module("miner_name", name)
    known = (*MINERS, NO_MINER)
    return MINERS[_match_name(name, known, suffix="Miner", argument="miner_name")](margin)


def batch_accuracy(
    loss: nn.Module, miner: nn.Module | None, mined: Any, photos: int
) -> float | None:
    """Return `b_acc` of the GSV-Cities code: the share of photos without a mined pair or triplet.

    These are the photos whose places the network already distinguishes. None where it is not
    meaningful: without a miner, with FastAP (mined pairs are weights there, so every photo is an
    anchor), and with the histogram miner (which samples pairs independently of what was learned).
    """
    if miner is None or isinstance(loss, FastAPLoss):
        return None
    if isinstance(miner, miners.UniformHistogramMiner):
        return None
    return 1.0 - len(torch.unique(mined[0])) / photos
