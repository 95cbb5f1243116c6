"""Points that are read piece by piece, and the batches that passes over them are made of."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import torch

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
