"""k-means for vocabularies: cosine assignment, centres are plain means of unit vectors.

As AnyLoc fits its vocabularies (the centres are not normalised again, so their norms are below 1),
but seeded with k-means++ and with empty clusters seeded anew. Deterministic for one seed, however
the iterations are cut into pieces.
"""

from __future__ import annotations

import torch

from shared.vision.vlad import assign

MAX_ITERATIONS = 100
TOLERANCE = 1e-4  # sum of squared movements of all centres at which they have settled


def seed_centres(points: torch.Tensor, clusters: int, seed: int) -> torch.Tensor:
    """k-means++ (Arthur and Vassilvitskii 2007): (n, D) unit points -> (clusters, D) of them."""
    generator = torch.Generator().manual_seed(seed)
    first = int(torch.randint(len(points), (1,), generator=generator))
    chosen = [first]
    distance = _squared_distance(points, points[first])
    for _ in range(clusters - 1):
        total = float(distance.sum(dtype=torch.float64))
        if total > 0:
            target = float(torch.rand(1, generator=generator, dtype=torch.float64)) * total
            cumulative = distance.cumsum(0, dtype=torch.float64)
            at = torch.searchsorted(cumulative, torch.tensor([target], dtype=torch.float64))
            index = min(int(at), len(points) - 1)
        else:  # fewer distinct points than clusters
            index = int(torch.randint(len(points), (1,), generator=generator))
        chosen.append(index)
        distance = torch.minimum(distance, _squared_distance(points, points[index]))
    return points[chosen].clone()


def iterate(points: torch.Tensor, centres: torch.Tensor) -> tuple[torch.Tensor, float]:
    """One Lloyd step: the new (K, D) centres and the sum of their squared movements.

    An empty cluster takes over the point that its own centre describes worst.
    """
    clusters = len(centres)
    labels = assign(points, centres)
    counts = torch.bincount(labels, minlength=clusters)
    sums = torch.zeros_like(centres).index_add_(0, labels, points)
    moved = sums / counts.clamp(min=1).unsqueeze(1)
    empty = (counts == 0).nonzero().flatten()
    if len(empty):
        worst = _squared_distance(points, moved[labels]).argsort(descending=True, stable=True)
        moved[empty] = points[worst[: len(empty)]]
    return moved, float(((moved - centres) ** 2).sum())


def _squared_distance(points: torch.Tensor, to: torch.Tensor) -> torch.Tensor:
    return ((points - to) ** 2).sum(dim=-1)
