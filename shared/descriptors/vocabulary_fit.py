"""Vocabulary fit: k-means from sampled patches to centres.

1. k-means++ on the first patches, which are a uniform sample, as the photos come in random order.
2. Mini-batch passes, each over all patches in batches of another order. The counts restart with
   each pass, so that centres do not keep the weight of early assignments: ten such passes describe
   patches as well as a hundred of Lloyd's (`lab/benchmarks/RESULTS.md`).
3. Lloyd's passes, until the centres converge: each is then the mean of its patches.

Memory holds one batch of points, the sample for k-means++, and a few arrays of the centres' size; a
GPU holds all points, which are at most PATCHES_BYTES (`shared.descriptors.patches`).
scikit-learn's MiniBatchKMeans assigns points by Euclidean distance; VLAD assigns them by cosine.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from shared.descriptors.kmeans import KMeansPass, choose_seeds
from shared.descriptors.vocabulary import ClusterCentres, parse_centres
from shared.errors import Unprocessable

PATCHES_PER_CLUSTER = 50  # with fewer, a centre depends on single patches of the sample
SEEDING_BYTES = 16_000_000  # of patches for k-means++, which reads all of them for each centre
SEEDING_PER_CLUSTER = 32  # minimum of patches per centre for k-means++
BATCH_PATCHES = 1024
BATCH_PER_CLUSTER = 16  # minimum of patches per centre in a batch
BLOCK_BYTES = 16_000_000  # of neighbouring batches, which follow each other also in random order
MINI_BATCH_PASSES = 10
SETTLING_PASSES = 10  # maximum of Lloyd's passes
TOLERANCE = 1e-4  # convergence: sum of the squared movements of all centres


class PointSource(Protocol):
    """(n, D) float32 unit vectors that can be read in ranges."""

    width: int
    """D"""

    def __len__(self) -> int: ...

    def read(self, begin: int, end: int) -> torch.Tensor:
        """Return rows [begin, end) on the CPU."""


@dataclass(frozen=True, slots=True)
class FittedCentres:
    """The result of a fit."""

    centres: ClusterCentres
    """The distinct ones: fewer than requested if the photos are too similar."""
    patches: int
    """Number of points that they were fitted to."""
    passes: int
    similarity: float
    """Mean cosine of the points to their centres in the last pass."""


def fit_centres(
    points: PointSource,
    clusters: int,
    seed: int,
    on_progress: Callable[[int, int], object] = lambda done, total: None,
    device: torch.device = torch.device("cpu"),
) -> FittedCentres:
    """Fit centres to points.

    Deterministic: the same points, seed and device give the same centres. Those of two devices
    differ by float32 rounding.

    Args:
        clusters: Requested number of centres, reduced so that each has at least
            PATCHES_PER_CLUSTER points.
        seed: Seed of k-means++ and of the batches' order.
        on_progress: Called with the seeds and batches done and their maximum; a fit that converges
            has fewer.
        device: Where to compute.

    Raises:
        Unprocessable: `no_photos` if there are no points.
    """
    count = len(points)
    if not count:
        raise Unprocessable(
            "no_photos",
            "None of the selected photos could be decoded, so there is nothing to fit on.",
        )
    clusters = max(1, min(clusters, count // PATCHES_PER_CLUSTER))
    rows = max(BATCH_PATCHES, BATCH_PER_CLUSTER * clusters)
    batches = max(1, round(count / rows))
    edges = np.linspace(0, count, batches + 1).round().astype(np.int64).tolist()
    per_block = max(1, BLOCK_BYTES // (rows * points.width * 4))
    total = clusters + (MINI_BATCH_PASSES + SETTLING_PASSES) * batches
    sample = max(SEEDING_PER_CLUSTER * clusters, SEEDING_BYTES // (4 * points.width))
    read = points.read
    if device.type != "cpu":
        on_device = points.read(0, count).to(device)
        read = lambda begin, end: on_device[begin:end]  # noqa: E731
    centres = choose_seeds(
        read(0, min(sample, count)), clusters, seed, lambda done: on_progress(done, total)
    )
    passes, settled, similarity = 0, False, 0.0
    while not settled:
        is_mini_batch = passes < MINI_BATCH_PASSES
        order = _shuffled(batches, per_block, [seed, passes]) if is_mini_batch else range(batches)
        statistics = KMeansPass.begin(centres)
        for done, batch in enumerate(order, start=1):
            statistics.accumulate(read(edges[batch], edges[batch + 1]), centres)
            if is_mini_batch:
                centres = statistics.means(centres)
            if done < batches:
                on_progress(clusters + passes * batches + done, total)
        moved = statistics.end(centres)
        movement = float(((moved - centres) ** 2).sum())
        centres, passes, similarity = moved, passes + 1, float(statistics.similarity) / count
        settled = passes == MINI_BATCH_PASSES + SETTLING_PASSES or (
            not is_mini_batch and movement <= TOLERANCE
        )
        on_progress(total if settled else clusters + passes * batches, total)
    distinct: NDArray[np.float32] = np.unique(centres.cpu().numpy(), axis=0)
    kept = parse_centres(distinct[np.linalg.norm(distinct, axis=1) > 1e-6])
    return FittedCentres(kept, count, passes, similarity)


def _shuffled(batches: int, per_block: int, seed: list[int]) -> list[int]:
    """Return the batch numbers in random order, block by block."""
    rng = np.random.default_rng(seed)
    order: list[int] = []
    for start in rng.permutation(np.arange(0, batches, per_block)):
        order += rng.permutation(np.arange(start, min(start + per_block, batches))).tolist()
    return order
