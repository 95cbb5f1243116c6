"""Losses by name, with the settings of the predecessor's published runs.

All are pytorch-metric-learning's. Two of them compute here what the library computes, by other
sums: with the hundreds of thousands of triplets that a miner may find in 400 photos, the library's
own take gigabytes.

Losses and miners are chosen by name.
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

from shared.errors import Unprocessable


def match_name(name: str, known: Sequence[str], *, suffix: str, argument: str) -> str:
    """The one of `known` that `name` means, in capitals or not, with or without the suffix.

    Unprocessable: `unknown_loss` or `unknown_miner`, by the suffix; it lists the known ones.
    """
    wanted = name.strip().lower().removesuffix(suffix.lower())
    for candidate in known:
        if candidate.lower().removesuffix(suffix.lower()) == wanted:
            return candidate
    raise Unprocessable(
        f"unknown_{suffix.lower()}",
        f"There is no {suffix.lower()} {name!r}. Known: {', '.join(known)} ({argument}).",
    )


class AngularLoss(losses.AngularLoss):  # type: ignore[misc]
    """Wang et al. 2017 (ICCV, "Deep Metric Learning with Angular Loss").

    Mean over the pairs (a, p) of log(1 + sum over the batch's photos n of other places of
    exp(4 tan^2(alpha) (a + p).n - 2 (1 + tan^2(alpha)) a.p)). A pair that comes in many triplets
    counts as often, but is computed once.
    """

    def compute_loss(
        self, embeddings: Any, labels: Any, indices_tuple: Any, ref_emb: Any, ref_labels: Any
    ) -> dict[str, Any]:
        a1, p, a2, n = loss_and_miner_utils.convert_to_pairs(indices_tuple, labels, ref_labels)
        if not len(a1) or not len(a2):
            return dict(self.zero_losses())
        (anchors, positives), of_pair = torch.unique(
            torch.stack([a1, p]), dim=1, return_inverse=True
        )
        found: dict[str, Any] = super().compute_loss(
            embeddings, labels, (anchors, positives, a2, n), ref_emb, ref_labels
        )
        found["loss"] |= {"losses": found["loss"]["losses"][of_pair], "indices": (a1, p)}
        return found


class NTXentLoss(losses.NTXentLoss):  # type: ignore[misc]
    """van den Oord et al. 2018 (InfoNCE); Chen et al. 2020 (SimCLR) name it so.

    Mean over the pairs (a, p) of -log(e^(s_ap / t) / (e^(s_ap / t) + sum over the negatives n of a
    of e^(s_an / t))), s the cosine. The sum over an anchor's negatives is the same for all of its
    pairs, and computed once.
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
        some = sums > 0
        # Where there are no negatives, the loss is 0; a 1 keeps its gradient from being NaN.
        of_anchor = largest + torch.where(some, sums, 1.0).log()
        found = torch.where(some[a1], softplus(of_anchor[a1] - positives), 0.0)
        return {"loss": {"losses": found, "indices": (a1, p), "reduction_type": "pos_pair"}}


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
    """The loss: called with (B, D) float32 rows, (B,) labels, and what a miner found or None; all
    pairs of the batch where that is None.

    `name`: a key of LOSSES, in capitals or not, with or without `Loss`. Unprocessable:
    `unknown_loss`.
    """
    return LOSSES[match_name(name, tuple(LOSSES), suffix="Loss", argument="loss_name")]()
