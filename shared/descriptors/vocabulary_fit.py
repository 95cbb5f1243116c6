"""A fit: from patches to centres, in steps that can be interrupted between any two.

1. k-means++ on the first patches: a uniform sample, as the photos come in a random order.
2. Mini-batch passes, each over all patches in batches of another order. Each pass counts anew, so
   that centres forget what was assigned to where they were long ago: ten such passes describe
   patches as well as a hundred of Lloyd's (`benchmarks/RESULTS.md`).
3. Lloyd's passes, until the centres have settled: each is then the mean of its patches.

What is kept in memory: one batch, the sample for k-means++, and a few arrays of the centres' size.

Points that are read piece by piece, and the batches that passes over them are made of.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from shared.descriptors.kmeans import KMeansPass, KMeansPlusPlus
from shared.descriptors.vocabulary import ClusterCentres, parse_centres
from shared.errors import Unprocessable

BLOCK_BYTES = 16_000_000  # read at once: a store on another machine is slow for each batch alone


class PointSource(Protocol):
    """(n, D) float32 unit vectors."""

    width: int
    """D"""

    def __len__(self) -> int: ...

    def read(self, begin: int, end: int) -> torch.Tensor:
        """(end - begin, D) on the CPU."""


class InMemoryPoints:
    """Points that are few enough to be held."""

    def __init__(self, points: torch.Tensor) -> None:
        """(n, D) float32 on the CPU."""
        self._points = points
        self.width = points.shape[1]

    def __len__(self) -> int:
        return len(self._points)

    def read(self, begin: int, end: int) -> torch.Tensor:
        return self._points[begin:end]


class PointBatches:
    """Points in batches of about equal size. Neighbours lie in one block, which is held."""

    def __init__(self, points: PointSource, rows: int) -> None:
        """`rows` are wanted in a batch."""
        self._points = points
        count = max(1, round(len(points) / rows))
        self._edges = np.linspace(0, len(points), count + 1).round().astype(np.int64).tolist()
        self._per_block = max(1, BLOCK_BYTES // (rows * points.width * 4))
        self._held: tuple[int, torch.Tensor] | None = None

    def __len__(self) -> int:
        return len(self._edges) - 1

    def shuffled(self, seed: list[int]) -> list[int]:
        """The batches in a random order that reads each block once."""
        rng = np.random.default_rng(seed)
        starts = np.arange(0, len(self), self._per_block)
        order: list[int] = []
        for start in rng.permutation(starts):
            order += rng.permutation(np.arange(start, self._end_of_block(start))).tolist()
        return order

    def read(self, batch: int) -> torch.Tensor:
        """(n, D) points of the batch of this number."""
        first = batch - batch % self._per_block
        if self._held is None or self._held[0] != first:
            begin, end = self._edges[first], self._edges[self._end_of_block(first)]
            self._held = None  # not two at a time
            self._held = first, self._points.read(begin, end)
        begin = self._edges[first]
        return self._held[1][self._edges[batch] - begin : self._edges[batch + 1] - begin]

    def _end_of_block(self, first: int) -> int:
        return min(first + self._per_block, len(self))


PATCHES_PER_CLUSTER = 50  # fewer, and a centre is an accident of the sample
SEEDING_BYTES = 16_000_000  # of patches for k-means++, which looks at all of them for each centre
SEEDING_PER_CLUSTER = 32  # or so many for each centre, where that is more
BATCH_PATCHES = 1024
BATCH_PER_CLUSTER = 16  # or so many for each centre, where that is more
TOLERANCE = 1e-4  # sum of squared movements of all centres at which they have settled


@dataclass(frozen=True, slots=True)
class FitEffort:
    """How long a fit tries."""

    mini_batch_passes: int = 10
    settling_passes: int = 10
    """At most."""


DEFAULT_EFFORT = FitEffort()


class VocabularyFitStage(StrEnum):
    SEED = "seed"
    MINI_BATCH = "mini-batch"
    SETTLE = "settle"
    DONE = "done"


class VocabularyFit:
    """Finds K centres for points; `step` until `done`. The same for the same points and seed,
    whether or not it was saved and resumed between two steps.
    """

    def __init__(
        self,
        points: PointSource,
        clusters: int,
        seed: int,
        effort: FitEffort = DEFAULT_EFFORT,
    ) -> None:
        """`clusters` are asked for; so few points that a centre had less than
        PATCHES_PER_CLUSTER of them bear fewer.

        Raises Unprocessable (`no_photos`) where there are no points.
        """
        if not len(points):
            raise Unprocessable(
                "no_photos",
                "None of the photos to learn from could be decoded: nothing to learn.",
            )
        self._points = points
        self.clusters = max(1, min(clusters, len(points) // PATCHES_PER_CLUSTER))
        self._seed = seed
        self._effort = effort
        self._batches = PointBatches(points, max(BATCH_PATCHES, BATCH_PER_CLUSTER * self.clusters))
        self.stage = VocabularyFitStage.SEED
        self.passes = 0
        """Ended ones."""
        self.similarity: float | None = None
        """Mean cosine of the points to their centres, as the last pass saw it."""
        self._seeding: KMeansPlusPlus | None = None
        self._centres = torch.empty(0, points.width)
        self._pass = KMeansPass.begin(self._centres)
        self._batch = 0
        """Batches that the pass has seen."""
        self._order: list[int] = []
        """Of the pass."""

    @property
    def patches(self) -> int:
        """Points that it learns from."""
        return len(self._points)

    @property
    def done(self) -> bool:
        return self.stage == VocabularyFitStage.DONE

    @property
    def progress(self) -> tuple[int, int]:
        """Steps done, and to be done at most."""
        batches = len(self._batches)
        passes = self._effort.mini_batch_passes + self._effort.settling_passes
        most = self.clusters + passes * batches
        if self.stage == VocabularyFitStage.SEED:
            return (len(self._seeding.chosen) if self._seeding else 0), most
        if self.done:
            return most, most
        return self.clusters + self.passes * batches + self._batch, most

    def step(self) -> None:
        """One seed, or one batch of points: milliseconds."""
        if self.stage == VocabularyFitStage.SEED:
            self._choose_seed()
        else:
            self._update_centres()

    def centres(self) -> ClusterCentres:
        """The centres of a fit that is done.

        Photos that are all alike can bear fewer than asked for: the distinct ones are kept.
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
        if self.stage == VocabularyFitStage.MINI_BATCH:
            self._centres = self._pass.means(self._centres)
        self._batch += 1
        if self._batch == len(self._batches):
            self._end_pass()

    def _end_pass(self) -> None:
        moved = self._pass.end(self._centres)
        movement = float(((moved - self._centres) ** 2).sum())
        self.similarity = self._pass.similarity / len(self._points)
        settled = self.stage == VocabularyFitStage.SETTLE and movement <= TOLERANCE
        self._centres = moved
        self.passes += 1
        self._begin_pass()
        if settled:
            self.stage = VocabularyFitStage.DONE

    def _begin_pass(self) -> None:
        self._batch = 0
        self._pass = KMeansPass.begin(self._centres)
        mini_batch = self._effort.mini_batch_passes
        if self.passes < mini_batch:
            self.stage = VocabularyFitStage.MINI_BATCH
        elif self.passes < mini_batch + self._effort.settling_passes:
            self.stage = VocabularyFitStage.SETTLE
        else:
            self.stage = VocabularyFitStage.DONE
        self._set_order()

    def _set_order(self) -> None:
        if self.stage == VocabularyFitStage.MINI_BATCH:
            self._order = self._batches.shuffled([self._seed, self.passes])
        else:
            self._order = list(range(len(self._batches)))

    # --- between two steps ---------------------------------------------------------------------

    def save(self) -> bytes:
        """All that `resume` needs beside the same points, clusters, seed and effort."""
        arrays: dict[str, Any] = {
            "numbers": np.array([self.passes, self._batch], np.int64),
            "similarity": np.array(np.nan if self.similarity is None else self.similarity),
            "stage": np.array(str(self.stage)),
            "centres": self._centres.numpy(),
            "counts": self._pass.counts.numpy(),
            "sums": self._pass.sums.numpy(),
            "seen": np.array(self._pass.similarity),
            "worst": self._pass.worst.numpy(),
            "worst_distances": self._pass.worst_distances.numpy(),
        }
        if self._seeding is not None:
            arrays["chosen"] = np.array(self._seeding.chosen)
            arrays["distances"] = self._seeding.distances.numpy()
            arrays["generator"] = self._seeding.generator.get_state().numpy()
        buffer = io.BytesIO()
        np.savez(buffer, allow_pickle=False, **arrays)
        return buffer.getvalue()

    def resume(self, data: bytes) -> None:
        """Go on where a fit of the same points, clusters, seed and effort was saved."""
        with np.load(io.BytesIO(data), allow_pickle=False) as saved:
            self.passes, self._batch = map(int, saved["numbers"])
            similarity = float(saved["similarity"])
            self.similarity = None if np.isnan(similarity) else similarity
            self.stage = VocabularyFitStage(str(saved["stage"]))
            self._centres = torch.from_numpy(saved["centres"])
            self._pass = KMeansPass(
                counts=torch.from_numpy(saved["counts"]),
                sums=torch.from_numpy(saved["sums"]),
                similarity=float(saved["seen"]),
                worst=torch.from_numpy(saved["worst"]),
                worst_distances=torch.from_numpy(saved["worst_distances"]),
            )
            if "chosen" in saved:
                self._seeding = KMeansPlusPlus.resume(
                    self._seeding_points(),
                    chosen=saved["chosen"].tolist(),
                    distances=torch.from_numpy(saved["distances"]),
                    generator_state=torch.from_numpy(saved["generator"]),
                )
        self._set_order()
