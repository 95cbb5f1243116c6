"""Points for k-means, and the full one of Lloyd's that every other is measured by."""

from __future__ import annotations

import torch
from torch.nn.functional import normalize

from shared.descriptors.kmeans import KMeansPass, choose_seeds


class InMemoryPoints:
    """A PointSource in memory."""

    def __init__(self, points: torch.Tensor) -> None:
        """`points`: (n, D) float32 on the CPU."""
        self._points = points
        self.width = points.shape[1]

    def __len__(self) -> int:
        return len(self._points)

    def read(self, begin: int, end: int) -> torch.Tensor:
        return self._points[begin:end]


def unit_points(seed: int, count: int, width: int) -> torch.Tensor:
    """(count, width) random directions."""
    generator = torch.Generator().manual_seed(seed)
    return normalize(torch.randn(count, width, generator=generator), dim=1)


def clustered_points(seed: int, count: int, width: int, clusters: int) -> torch.Tensor:
    """(count, width) unit vectors around `clusters` directions, as unequal as patches are: some
    clusters are hundreds of times as large as others, and they overlap.
    """
    generator = torch.Generator().manual_seed(seed)
    shares = torch.arange(1, clusters + 1, dtype=torch.float32) ** -1.0
    own = torch.multinomial(shares, count, replacement=True, generator=generator)
    middles = normalize(torch.randn(clusters, width, generator=generator), dim=1)
    noise = torch.randn(count, width, generator=generator) * (0.9 / width**0.5)
    return normalize(middles[own] + noise, dim=1)


def full_kmeans(points: torch.Tensor, clusters: int, seed: int) -> torch.Tensor:
    """(clusters, width) centres by k-means++ and up to 100 of Lloyd's passes over all points."""
    centres = choose_seeds(points, clusters, seed)
    for _ in range(100):
        one = KMeansPass.begin(centres)
        one.accumulate(points, centres)
        before, centres = centres, one.end(centres)
        if float(((centres - before) ** 2).sum()) <= 1e-4:
            break
    return centres


def mean_cosine(points: torch.Tensor, centres: torch.Tensor) -> float:
    """Of the points to their nearest centres: what cosine k-means maximises."""
    return float((points @ normalize(centres, dim=1).T).max(dim=1).values.mean())
