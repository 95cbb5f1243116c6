"""Vocabulary fit: k-means from sampled patches to centres, in resumable steps.

1. k-means++ on the first patches, which are a uniform sample, as the photos come in random order.
2. Mini-batch passes, each over all patches in batches of another order. The counts restart with
   each pass, so that centres do not keep the weight of early assignments: ten such passes describe
   patches as well as a hundred of Lloyd's (`lab/benchmarks/RESULTS.md`).
3. Lloyd's passes, until the centres converge: each is then the mean of its patches.

Memory holds one block of points, the sample for k-means++, and a few arrays of the centres' size. A
fit can be saved and resumed between any two steps. scikit-learn's MiniBatchKMeans assigns points by
Euclidean distance; VLAD assigns them by cosine.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from shared.descriptors.kmeans import KMeansPass, KMeansPlusPlus
from shared.descriptors.vocabulary import ClusterCentres, parse_centres
from shared.errors import Unprocessable

BLOCK_BYTES = 16_000_000  # read at once: one request per batch is slow on a remote object store


class PointSource(Protocol):
    """(n, D) float32 unit vectors that can be read in ranges."""

    width: int
    """D"""

    def __len__(self) -> int: ...

    def read(self, begin: int, end: int) -> torch.Tensor:
        """Return rows [begin, end) on the CPU."""


class PointBatches:
    """Points in batches of about equal size, read in blocks of several batches.

    The last block is cached.
    """

    def __init__(self, points: PointSource, rows: int) -> None:
        """`rows`: the target batch size."""
        self._points = points
        count = max(1, round(len(points) / rows))
        self._edges = np.linspace(0, len(points), count + 1).round().astype(np.int64).tolist()
        self._per_block = max(1, BLOCK_BYTES // (rows * points.width * 4))
        self._cached: tuple[int, torch.Tensor] | None = None

    def __len__(self) -> int:
        return len(self._edges) - 1

    def shuffled(self, seed: list[int]) -> list[int]:
        """Return the batch numbers in a random order that reads each block once."""
        rng = np.random.default_rng(seed)
        starts = np.arange(0, len(self), self._per_block)
        order: list[int] = []
        for start in rng.permutation(starts):
            order += rng.permutation(np.arange(start, self._end_of_block(start))).tolist()
        return order

    def read(self, batch: int) -> torch.Tensor:
        """Return the (n, D) points of a batch, by its number."""
        first = batch - batch % self._per_block
        if self._cached is None or self._cached[0] != first:
            begin, end = self._edges[first], self._edges[self._end_of_block(first)]
            self._cached = None  # released first, to hold one block at a time
            self._cached = first, self._points.read(begin, end)
        begin = self._edges[first]
        return self._cached[1][self._edges[batch] - begin : self._edges[batch + 1] - begin]

    def _end_of_block(self, first: int) -> int:
        return min(first + self._per_block, len(self))


PATCHES_PER_CLUSTER = 50  # with fewer, a centre depends on single patches of the sample
SEEDING_BYTES = 16_000_000  # of patches for k-means++, which reads all of them for each centre
SEEDING_PER_CLUSTER = 32  # minimum of patches per centre for k-means++
BATCH_PATCHES = 1024
BATCH_PER_CLUSTER = 16  # minimum of patches per centre in a batch
TOLERANCE = 1e-4  # convergence: sum of the squared movements of all centres


@dataclass(frozen=True, slots=True)
class FitEffort:
    """Numbers of passes of a fit."""

    mini_batch_passes: int = 10
    settling_passes: int = 10
    """Maximum of Lloyd's passes."""


DEFAULT_EFFORT = FitEffort()


class _VocabularyFitStage(StrEnum):
    """The stages of a fit, in their order."""

    SEED = "seed"
    MINI_BATCH = "mini-batch"
    SETTLE = "settle"
    DONE = "done"


class VocabularyFit:
    """Fits K centres to points: call `step` until `done`.

    Deterministic: the same points and seed give the same centres.
    """

    def __init__(
        self,
        points: PointSource,
        clusters: int,
        seed: int,
        effort: FitEffort = DEFAULT_EFFORT,
    ) -> None:
        """Prepare a fit.

        Args:
            clusters: Requested number of centres, reduced so that each has at least
                PATCHES_PER_CLUSTER points.
            seed: Seed of k-means++ and of the batches' order.

        Raises:
            Unprocessable: `no_photos` if there are no points.
        """
        if not len(points):
            raise Unprocessable(
                "no_photos",
                "None of the selected photos could be decoded, so there is nothing to fit on.",
            )
        self._points = points
        self.clusters = max(1, min(clusters, len(points) // PATCHES_PER_CLUSTER))
        self._seed = seed
        self._effort = effort
        self._batches = PointBatches(points, max(BATCH_PATCHES, BATCH_PER_CLUSTER * self.clusters))
        self.stage = _VocabularyFitStage.SEED
        self.passes = 0
        """Completed passes."""
        self.similarity: float | None = None
        """Mean cosine of the points to their centres in the last completed pass."""
        self._seeding: KMeansPlusPlus | None = None
        self._centres = torch.empty(0, points.width)
        self._pass = KMeansPass.begin(self._centres)
        self._batch = 0
        """Batches done in the current pass."""
        self._order: list[int] = []
        """Batch numbers of the current pass, in their order."""

    @property
    def patches(self) -> int:
        """Number of points that the fit uses."""
        return len(self._points)

    @property
    def done(self) -> bool:
        return self.stage == _VocabularyFitStage.DONE

    @property
    def progress(self) -> tuple[int, int]:
        """Number of steps done, and the maximum number of steps: a fit that converges has fewer."""
        batches = len(self._batches)
        passes = self._effort.mini_batch_passes + self._effort.settling_passes
        total = self.clusters + passes * batches
        if self.stage == _VocabularyFitStage.SEED:
            return (len(self._seeding.chosen) if self._seeding else 0), total
        if self.done:
            return total, total
        return self.clusters + self.passes * batches + self._batch, total

    def step(self) -> None:
        """Choose one seed, or process one batch of points; takes milliseconds."""
        if self.stage == _VocabularyFitStage.SEED:
            self._choose_seed()
        else:
            self._update_centres()

    def centres(self) -> ClusterCentres:
        """Return the distinct centres of a completed fit.

        Fewer than requested if the photos are too similar.
        """
        assert self.done
        distinct: NDArray[np.float32] = np.unique(self._centres.numpy(), axis=0)
        return parse_centres(distinct[np.linalg.norm(distinct, axis=1) > 1e-6])

    def _choose_seed(self) -> None:
        if self._seeding is None:
            self._seeding = KMeansPlusPlus(self._seeding_points(), self._seed)
        else:
            self._seeding.next()
        if len(self._seeding.chosen) == self.clusters:
            self._centres = self._seeding.centres()
            self._seeding = None
            self._begin_pass()

    def _seeding_points(self) -> torch.Tensor:
        size = max(
            SEEDING_PER_CLUSTER * self.clusters,
            SEEDING_BYTES // (4 * self._points.width),
        )
        return self._points.read(0, min(size, len(self._points)))

    def _update_centres(self) -> None:
        points = self._batches.read(self._order[self._batch])
        self._pass.accumulate(points, self._centres)
        if self.stage == _VocabularyFitStage.MINI_BATCH:
            self._centres = self._pass.means(self._centres)
        self._batch += 1
        if self._batch == len(self._batches):
            self._end_pass()

    def _end_pass(self) -> None:
        moved = self._pass.end(self._centres)
        movement = float(((moved - self._centres) ** 2).sum())
        self.similarity = self._pass.similarity / len(self._points)
        settled = self.stage == _VocabularyFitStage.SETTLE and movement <= TOLERANCE
        self._centres = moved
        self.passes += 1
        self._begin_pass()
        if settled:
            self.stage = _VocabularyFitStage.DONE

    def _begin_pass(self) -> None:
        self._batch = 0
        self._pass = KMeansPass.begin(self._centres)
        mini_batch = self._effort.mini_batch_passes
        if self.passes < mini_batch:
            self.stage = _VocabularyFitStage.MINI_BATCH
        elif self.passes < mini_batch + self._effort.settling_passes:
            self.stage = _VocabularyFitStage.SETTLE
        else:
            self.stage = _VocabularyFitStage.DONE
        self._set_order()

    def _set_order(self) -> None:
        if self.stage == _VocabularyFitStage.MINI_BATCH:
            self._order = self._batches.shuffled([self._seed, self.passes])
        else:
            self._order = list(range(len(self._batches)))
