"""Metric-learning losses by name, with the settings of the published GSV-Cities runs.

All losses come from pytorch-metric-learning. AngularLoss and NTXentLoss are reimplemented with
equal results and less memory: a miner may find hundreds of thousands of triplets in 400 photos, for
which the library's versions allocate gigabytes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from pytorch_metric_learning import losses
from pytorch_metric_learning.distances import DotProductSimilarity
from pytorch_metric_learning.utils import loss_and_miner_utils
from torch import nn
from torch.nn.functional import softplus

from services.trainer.model_factory import make_own_module
from shared.descriptors.vpr_models.config import is_own_module
from shared.errors import Unprocessable


def match_name(name: str, known: Sequence[str], *, suffix: str, argument: str) -> str:
    """Return the element of `known` that equals `name`, ignoring case and the suffix.

    Raises:
        Unprocessable: `unknown_loss` or `unknown_miner`, by the suffix; lists the known names.
    """
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
    """Create a loss by name.

    The loss is called with (B, D) float32 embeddings, (B,) labels, and the indices that a miner
    returned; None uses all pairs of the batch.

    Args:
        name: a key of LOSSES, in any case, with or without `Loss`; or `package.module:Class`.

    Raises:
        Unprocessable: `unknown_loss`.
        InvalidRequest: `own_module_unfit`.
    """
    if is_own_module(name):
        return make_own_module("loss_name", name)
    return LOSSES[match_name(name, tuple(LOSSES), suffix="Loss", argument="loss_name")]()
