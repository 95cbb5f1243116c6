"""k-means on batches of points: cosine assignment, unnormalised means as centres.

This is how AnyLoc fits vocabularies (centres are not normalised again, so their norms are below 1),
with three changes: k-means++ seeding, reseeding of empty clusters, and points read in batches:

    mini-batch (Sculley 2010)   c <- c + (x - c) / n_c for each point x assigned to c, where n_c
                                counts them: after each batch c is the mean of its points
    Lloyd                       all points against the same centres, which then move to the means

Points and centres are on one device. Nothing is summed in an order that is left to a GPU's threads,
so that a repeated fit gives the same centres.

`shared.descriptors.vocabulary_fit` schedules the passes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch.nn.functional import normalize, one_hot


def choose_seeds(
    points: torch.Tensor,
    count: int,
    seed: int,
    on_seed: Callable[[int], object] = lambda done: None,
) -> torch.Tensor:
    """Choose (count, D) initial centres among (n, D) points by k-means++.

    Each has a probability proportional to its squared distance to the nearest one before it (Arthur
    and Vassilvitskii 2007). `on_seed` is called with the number of centres chosen.
    """
    generator = torch.Generator().manual_seed(seed)
    chosen = [int(torch.randint(len(points), (1,), generator=generator))]
    distances = _squared_distances(points, points[chosen[0]])
    on_seed(1)
    while len(chosen) < count:
        cumulative = distances.cpu().cumsum(0, dtype=torch.float64)
        total = float(cumulative[-1])
        if total > 0:
            target = torch.rand(1, generator=generator, dtype=torch.float64) * total
            index = min(int(torch.searchsorted(cumulative, target)), len(points) - 1)
        else:  # fewer distinct points than seeds
            index = int(torch.randint(len(points), (1,), generator=generator))
        chosen.append(index)
        distances = torch.minimum(distances, _squared_distances(points, points[index]))
        on_seed(len(chosen))
    return points[chosen].clone()


@dataclass(slots=True)
class KMeansPass:
    """Accumulated statistics of one pass over the points; K clusters, D dimensions."""

    counts: torch.Tensor
    """(K,) int64: number of points assigned to each centre."""
    sums: torch.Tensor
    """(K, D) sum of the points assigned to each centre."""
    similarity: torch.Tensor
    """Sum of the points' cosines to their centres, a float64 scalar on the device."""
    worst: torch.Tensor
    """(at most K, D) points farthest from their centres, farthest first."""
    worst_distances: torch.Tensor
    """Squared distances of `worst` to their centres, in the same order."""

    @classmethod
    def begin(cls, centres: torch.Tensor) -> KMeansPass:
        """Start a pass with centres of this shape (K, D)."""
        return cls(
            counts=torch.zeros(len(centres), dtype=torch.int64, device=centres.device),
            sums=torch.zeros_like(centres),
            similarity=torch.zeros((), dtype=torch.float64, device=centres.device),
            worst=centres[:0],
            worst_distances=centres[:0, 0],
        )

    def accumulate(self, points: torch.Tensor, centres: torch.Tensor) -> None:
        """Assign the (n, D) unit points to their most similar centres."""
        cosines, labels = (points @ normalize(centres, dim=-1).T).max(dim=-1)
        self.counts += torch.bincount(labels, minlength=len(centres))
        if points.is_cuda:  # index_add_ would sum in any order there
            self.sums += one_hot(labels, len(centres)).to(points.dtype).T @ points
        else:
            self.sums.index_add_(0, labels, points)
        self.similarity += cosines.sum(dtype=torch.float64)
        norms = centres.norm(dim=-1)[labels]
        distances = 1 - 2 * cosines * norms + norms**2
        farthest = distances.argsort(descending=True, stable=True)[: len(centres)]
        distances = torch.cat([self.worst_distances, distances[farthest]])
        order = distances.argsort(descending=True, stable=True)[: len(centres)]
        self.worst = torch.cat([self.worst, points[farthest]])[order]
        self.worst_distances = distances[order]

    def means(self, centres: torch.Tensor) -> torch.Tensor:
        """Return the (K, D) means of the points; a centre without points stays where it is."""
        means = self.sums / self.counts.clamp(min=1).unsqueeze(1)
        return torch.where((self.counts > 0).unsqueeze(1), means, centres)

    def end(self, centres: torch.Tensor) -> torch.Tensor:
        """Return the means after a pass; a centre without points moves to one of `worst`."""
        moved = self.means(centres)
        empty = (self.counts == 0).nonzero().flatten()[: len(self.worst)]
        moved[empty] = self.worst[: len(empty)]
        return moved


def _squared_distances(points: torch.Tensor, to: torch.Tensor) -> torch.Tensor:
    return ((points - to) ** 2).sum(dim=-1)
