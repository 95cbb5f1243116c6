"""The exact end of a search: rows that may matter are compared one by one, the best first.

Where the rows of a snapshot lie in memory, for the compiled loops.

One piece of work over many rows, on several processors.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.search.chunk_loader import LoadedChunk
from services.search.kernels import exact_products

Addresses = NDArray[np.uint64]
Indices = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class RowBlocks:
    """n rows in c blocks; who makes it keeps them alive."""

    dimension: int
    first_rows: Indices
    """(c + 1,): the number of each block's first row; the last is n."""
    row_addresses: Addresses
    """(c,): where the block's float32 rows begin."""
    keep_alive: object
    """What has to live as long."""

    @classmethod
    def of(cls, chunks: Sequence[LoadedChunk]) -> RowBlocks:
        return cls(
            dimension=chunks[0].rows.shape[1],
            first_rows=np.cumsum([0, *(len(chunk.rows) for chunk in chunks)]),
            row_addresses=array_addresses(chunk.rows for chunk in chunks),
            keep_alive=chunks,
        )

    def __len__(self) -> int:
        return int(self.first_rows[-1])


def array_addresses(arrays: Iterable[NDArray[Any]]) -> Addresses:
    """Where each array begins."""
    return np.array([array.ctypes.data for array in arrays], np.uint64)


MIN_PART_BYTES = 4_000_000  # less is done before another thread has woken up


def parallel_for(run_range: Callable[[int, int], None], rows: int, bytes_each: int) -> None:
    """Call `work(begin, end)` for parts that make up 0 to `rows`, of so many bytes each row.

    One part is worked on here. `run_range` has to let go of the interpreter's lock to gain
    anything.
    """
    parts = max(1, min(_cpu_count(), rows * bytes_each // MIN_PART_BYTES))
    ends = [rows * (part + 1) // parts for part in range(parts)]
    others = [_thread_pool().submit(run_range, *span) for span in pairwise(ends)]
    run_range(0, ends[0])
    for other in others:
        other.result()


@cache
def _cpu_count() -> int:
    """Those that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@cache
def _thread_pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max(1, _cpu_count() - 1), "search-part")


RERANK_STEP_ROWS = 8  # rows compared exactly between two looks at the floor

Scores = NDArray[np.float64]


@dataclass(slots=True)
class SearchBudget:
    """When to give up: an answer that was cut short says so."""

    max_rows: int | None = None
    """So many are compared exactly, and no more."""
    deadline: float | None = None
    """Of time.monotonic()."""

    def is_exhausted(self, rows: int) -> bool:
        if self.max_rows is not None and rows >= self.max_rows:
            return True
        return self.deadline is not None and time.monotonic() >= self.deadline


@dataclass(frozen=True, slots=True, eq=False)
class RerankedRows:
    """Rows that were compared exactly, and what is known of the others."""

    rows: Indices
    """The first so many of those that were to be compared, in their order."""
    scores: Scores
    """Cosines, float64."""
    unseen_bound: float
    """No other row reaches more than this; -inf where none can matter."""

    @property
    def is_complete(self) -> bool:
        """Whether it did not end early."""
        return self.unseen_bound == -math.inf


@dataclass(frozen=True, slots=True, eq=False)
class ExactReranker:
    """Exact comparison of rows with one query, for its `k` best."""

    blocks: RowBlocks
    query: NDArray[np.float32]
    """(dimension,) of any length but 0."""
    norm: float
    """Its length."""
    k: int
    prefetch: Callable[[Indices], None]
    """Is told of rows before they are compared."""

    def find_best(
        self, rows: Indices, upper_bounds: Scores, floor: float, budget: SearchBudget
    ) -> RerankedRows:
        """Compare `rows`, of which none scores more than its `upper_bounds`, highest reach
        first; until
        no other reaches `floor`, which rises to the k-th score."""
        order = np.argsort(-upper_bounds, kind="stable")
        order = order[: np.count_nonzero(upper_bounds >= floor)]
        rows, upper_bounds = rows[order], upper_bounds[order]
        scores = np.empty(len(rows))
        done, unseen = 0, -math.inf
        while done < len(rows) and upper_bounds[done] >= floor:
            if budget.is_exhausted(done):
                unseen = float(upper_bounds[done])
                break
            # The first k are needed in any case.
            upto = min(
                len(rows), max(self.k, done + RERANK_STEP_ROWS), budget.max_rows or len(rows)
            )
            self.prefetch(rows[done:upto])
            self._multiply(rows[done:upto], scores[done:upto])
            scores[done:upto] /= self.norm
            done = upto
            if done >= self.k:
                kth = float(np.partition(scores[:done], done - self.k)[done - self.k])
                floor = max(floor, kth)
        return RerankedRows(rows[:done], scores[:done], unseen)

    def _multiply(self, rows: Indices, out: Scores) -> None:
        blocks = self.blocks
        parallel_for(
            lambda i, j: exact_products(
                blocks.row_addresses, blocks.first_rows, rows[i:j], self.query, out[i:j]
            ),
            len(rows),
            4 * blocks.dimension,
        )
