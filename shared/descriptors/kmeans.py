"""k-means for vocabularies, a batch of points at a time: cosine assignment, plain means as centres.

As AnyLoc fits its vocabularies (the centres are not normalised again, so their norms are below 1),
but seeded with k-means++, with empty clusters seeded anew, and without ever holding all points:

    mini-batch (Sculley 2010)   c <- c + (x - c) / n_c for each point x that c describes best, and
                                n_c counts them: after each batch c is the mean of its points
    Lloyd                       all points against the same centres, which then move to the means

`shared.descriptors.vocabulary_fit` says how often which, and goes on where it was interrupted.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch.nn.functional import normalize


class KMeansPlusPlus:
    """k-means++ (Arthur and Vassilvitskii 2007) on (n, D) points, one seed at a time."""

    def __init__(self, points: torch.Tensor, seed: int) -> None:
        self.points = points
        self.generator = torch.Generator().manual_seed(seed)
        first = int(torch.randint(len(points), (1,), generator=self.generator))
        self.chosen = [first]
        """Rows of the points that are seeds."""
        self.distances = _squared_distances(points, points[first])
        """(n,) from each point to its nearest seed, squared."""

    @classmethod
    def resume(
        cls,
        points: torch.Tensor,
        *,
        chosen: list[int],
        distances: torch.Tensor,
        generator_state: torch.Tensor,
    ) -> KMeansPlusPlus:
        """One that had chosen these of the same points; `generator_state` is `generator`'s."""
        found = cls.__new__(cls)
        found.points, found.chosen, found.distances = points, chosen, distances
        found.generator = torch.Generator()
        found.generator.set_state(generator_state)
        return found

    def next(self) -> None:
        """Choose one more, with a probability that grows with its distance to those there are."""
        total = float(self.distances.sum(dtype=torch.float64))
        if total > 0:
            target = float(torch.rand(1, generator=self.generator, dtype=torch.float64)) * total
            cumulative = self.distances.cumsum(0, dtype=torch.float64)
            at = torch.searchsorted(cumulative, torch.tensor([target], dtype=torch.float64))
            index = min(int(at), len(self.points) - 1)
        else:  # fewer distinct points than seeds
            index = int(torch.randint(len(self.points), (1,), generator=self.generator))
        self.chosen.append(index)
        new = _squared_distances(self.points, self.points[index])
        self.distances = torch.minimum(self.distances, new)

    def centres(self) -> torch.Tensor:
        """(seeds, D)"""
        return self.points[self.chosen].clone()


@dataclass(slots=True)
class KMeansPass:
    """What one pass over the points has seen so far, of K clusters in D dimensions."""

    counts: torch.Tensor
    """(K,) int64: points that each centre describes best."""
    sums: torch.Tensor
    """(K, D) of those points."""
    similarity: float
    """Sum of the points' cosines to their centres."""
    worst: torch.Tensor
    """(at most K, D) points that their own centres describe worst, the worst first."""
    worst_distances: torch.Tensor
    """Theirs, squared."""

    @classmethod
    def begin(cls, centres: torch.Tensor) -> KMeansPass:
        return cls(
            counts=torch.zeros(len(centres), dtype=torch.int64),
            sums=torch.zeros_like(centres),
            similarity=0.0,
            worst=centres[:0],
            worst_distances=centres[:0, 0],
        )

    def accumulate(self, points: torch.Tensor, centres: torch.Tensor) -> None:
        """Count the (n, D) unit points to the centres that describe them best."""
        cosines, labels = (points @ normalize(centres, dim=-1).T).max(dim=-1)
        self.counts += torch.bincount(labels, minlength=len(centres))
        self.sums.index_add_(0, labels, points)
        self.similarity += float(cosines.sum(dtype=torch.float64))
        norms = centres.norm(dim=-1)[labels]
        distances = 1 - 2 * cosines * norms + norms**2
        own = distances.argsort(descending=True, stable=True)[: len(centres)]
        distances = torch.cat([self.worst_distances, distances[own]])
        order = distances.argsort(descending=True, stable=True)[: len(centres)]
        self.worst = torch.cat([self.worst, points[own]])[order]
        self.worst_distances = distances[order]

    def means(self, centres: torch.Tensor) -> torch.Tensor:
        """(K, D) where the centres move: the means of their points; without points they stay."""
        means = self.sums / self.counts.clamp(min=1).unsqueeze(1)
        return torch.where((self.counts > 0).unsqueeze(1), means, centres)

    def end(self, centres: torch.Tensor) -> torch.Tensor:
        """The means at the end: a centre without points takes over one of the worst described."""
        moved = self.means(centres)
        empty = (self.counts == 0).nonzero().flatten()[: len(self.worst)]
        moved[empty] = self.worst[: len(empty)]
        return moved


def _squared_distances(points: torch.Tensor, to: torch.Tensor) -> torch.Tensor:
    return ((points - to) ** 2).sum(dim=-1)
