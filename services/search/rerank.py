"""The exact end of a search: rows that may matter are compared one by one, the best first."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.search.blocks import Indices, RowBlocks
from services.search.kernels import products_at
from services.search.parts import in_parts

STEP = 8  # rows compared exactly between two looks at the floor

Scores = NDArray[np.float64]


@dataclass(slots=True)
class Budget:
    """When to give up: an answer that was cut short says so."""

    rows: int | None = None
    """So many are compared exactly, and no more."""
    until: float | None = None
    """Of time.monotonic()."""

    def spent(self, rows: int) -> bool:
        if self.rows is not None and rows >= self.rows:
            return True
        return self.until is not None and time.monotonic() >= self.until


@dataclass(frozen=True, slots=True, eq=False)
class Compared:
    """Rows that were compared exactly, and what is known of the others."""

    rows: Indices
    """The first so many of those that were to be compared, in their order."""
    scores: Scores
    """Cosines, float64."""
    unseen: float
    """No other row reaches more than this; -inf where none can matter."""

    @property
    def whole(self) -> bool:
        """Whether it did not end early."""
        return self.unseen == -math.inf


@dataclass(frozen=True, slots=True, eq=False)
class Rerank:
    """Exact comparison of rows with one query, for its `k` best."""

    blocks: RowBlocks
    query: NDArray[np.float32]
    """(dimension,) of any length but 0."""
    norm: float
    """Its length."""
    k: int
    read_ahead: Callable[[Indices], None]
    """Is told of rows before they are compared."""

    def best(self, rows: Indices, reach: Scores, floor: float, budget: Budget) -> Compared:
        """Compare `rows`, of which none scores more than its `reach`, highest reach first; until
        no other reaches `floor`, which rises to the k-th score."""
        order = np.argsort(-reach, kind="stable")
        order = order[: np.count_nonzero(reach >= floor)]
        rows, reach = rows[order], reach[order]
        scores = np.empty(len(rows))
        done, unseen = 0, -math.inf
        while done < len(rows) and reach[done] >= floor:
            if budget.spent(done):
                unseen = float(reach[done])
                break
            # The first k are needed in any case.
            upto = min(len(rows), max(self.k, done + STEP), budget.rows or len(rows))
            self.read_ahead(rows[done:upto])
            self._multiply(rows[done:upto], scores[done:upto])
            scores[done:upto] /= self.norm
            done = upto
            if done >= self.k:
                kth = float(np.partition(scores[:done], done - self.k)[done - self.k])
                floor = max(floor, kth)
        return Compared(rows[:done], scores[:done], unseen)

    def _multiply(self, rows: Indices, out: Scores) -> None:
        blocks = self.blocks
        in_parts(
            lambda i, j: products_at(blocks.rows, blocks.first, rows[i:j], self.query, out[i:j]),
            len(rows),
            4 * blocks.dimension,
        )
