"""Exact reranking of candidates, addresses of rows for compiled loops, and a parallel for loop."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from services.search.chunk_loader import LoadedChunk
from services.search.kernels import row_products
from shared.config.settings import usable_processors

Addresses = NDArray[np.uint64]
Indices = NDArray[np.int64]
Scores = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class RowBlocks:
    """Addresses of n rows in c blocks; `keep_alive` keeps their memory alive."""

    dimension: int
    first_rows: Indices
    """(c + 1,): number of each block's first row; the last is n."""
    row_addresses: Addresses
    """(c,): start address of each block's rows."""
    number_bytes: Indices
    """(c,): bytes of a number of each block's rows: 4 for float32, 2 for float16."""
    keep_alive: object
    """Owner of the memory, which must live as long as the addresses are used."""

    @classmethod
    def of(cls, chunks: Sequence[LoadedChunk]) -> RowBlocks:
        """Create them from chunks, one block each."""
        return cls.with_codes(chunks)

    @classmethod
    def with_codes(cls, chunks: Sequence[LoadedChunk], **codes: Any) -> Self:
        """Create them from chunks; `codes` are the fields that a subclass adds."""
        return cls(
            dimension=chunks[0].rows.shape[1],
            first_rows=np.cumsum([0, *(len(chunk.rows) for chunk in chunks)]),
            row_addresses=array_addresses(chunk.rows for chunk in chunks),
            number_bytes=np.array([chunk.rows.itemsize for chunk in chunks]),
            keep_alive=chunks,
            **codes,
        )

    def __len__(self) -> int:
        return int(self.first_rows[-1])

    def multiply(
        self, rows: Indices, query: NDArray[np.float32], out: NDArray[np.floating]
    ) -> None:
        """Write the products of the given rows with the query to `out`, on all CPUs.

        They are summed in the type of `out`, float32 or float64.
        """
        parallel_for(
            lambda i, j: row_products(
                self.row_addresses, self.first_rows, self.number_bytes, rows[i:j], query, out[i:j]
            ),
            len(rows),
            int(self.number_bytes.max()) * self.dimension,
        )


def array_addresses(arrays: Iterable[NDArray[Any]]) -> Addresses:
    """Return the start address of each array."""
    return np.array([array.ctypes.data for array in arrays], np.uint64)


MIN_PART_BYTES = 4_000_000  # smaller parts are not worth waking up another thread


def parallel_for(run_range: Callable[[int, int], None], rows: int, bytes_each: int) -> None:
    """Run a loop over rows in parallel on the available CPUs.

    Args:
        run_range: Called with (begin, end) for parts that cover 0 to `rows`; it must release the
            GIL for a speedup. One part runs in the calling thread.
        rows: Number of rows.
        bytes_each: Bytes of work for each row, which determine the number of parts.
    """
    parts = min(_processors(), rows * bytes_each // MIN_PART_BYTES)
    if parts <= 1:
        run_range(0, rows)
        return
    ends = [rows * (part + 1) // parts for part in range(parts)]
    others = [_thread_pool().submit(run_range, *span) for span in pairwise(ends)]
    run_range(0, ends[0])
    for other in others:
        other.result()


_processors = cache(usable_processors)


@cache
def _thread_pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max(1, _processors() - 1), "search-part")


# Minimum number of rows compared exactly between two checks of the floor. A step is
# at least an eighth of the rows compared before: long results occupy all threads, and at most an
# eighth of the rows is compared in vain.
RERANK_STEP_ROWS = 8


@dataclass(frozen=True, slots=True, eq=False)
class ExactReranker:
    """Compares candidates exactly with one query, to find its `k` best."""

    blocks: RowBlocks
    query: NDArray[np.float32]
    """(dimension,) row of any length but 0."""
    norm: float
    """Length of the query."""
    k: int
    prefetch: Callable[[Indices], None]
    """Called with rows before they are compared."""

    def find_best(
        self, rows: Indices, upper_bounds: Scores, floor: float
    ) -> tuple[Indices, Scores]:
        """Compare rows by descending upper bound, until no other row can reach the k-th score.

        Args:
            rows: Candidates.
            upper_bounds: Upper bound of each candidate's score.
            floor: Score that a row must reach; it rises to the k-th exact score.

        Returns:
            The compared rows, by descending upper bound, and their float64 cosines.
        """
        order = np.argsort(-upper_bounds, kind="stable")
        order = order[: np.count_nonzero(upper_bounds >= floor)]
        rows, upper_bounds = rows[order], upper_bounds[order]
        scores = np.empty(len(rows))
        done = 0
        while done < len(rows) and upper_bounds[done] >= floor:
            # At least k rows are needed before the floor can rise.
            step = max(RERANK_STEP_ROWS, done // 8)
            end = min(len(rows), max(self.k, done + step))
            self.prefetch(rows[done:end])
            self.blocks.multiply(rows[done:end], self.query, scores[done:end])
            scores[done:end] /= self.norm
            done = end
            if done >= self.k:
                kth = float(np.partition(scores[:done], done - self.k)[done - self.k])
                floor = max(floor, kth)
        return rows[:done], scores[:done]
