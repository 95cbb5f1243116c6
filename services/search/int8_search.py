"""Exact top-k by int8 codes: a proven bound excludes every row that is not compared exactly.

1. The product of each row's code with the query's code is its score to within a bound
   (`shared.codes.int8_codes`). The k-th highest score minus bound is a floor of the result.
2. Rows whose score plus bound reaches the floor are compared exactly, the highest first, until no
   other row can reach the k-th exact score.

Nothing is probabilistic: every error is bounded by the lengths of the rounding residuals.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.search.chunk_loader import LoadedChunk
from services.search.exact_rerank import (
    Addresses,
    Indices,
    RowBlocks,
    Scores,
    SearchBudget,
    array_addresses,
)
from services.search.kernels import rows_above_floor
from shared.codes.int8_codes import Int8Query

BUDGET_CHECK_BYTES = 1 << 28  # of codes between two checks of the deadline: about 10 ms


@dataclass(frozen=True, slots=True, eq=False)
class Int8Blocks(RowBlocks):
    """Addresses of the int8 codes and rows of n photos in c blocks."""

    code_addresses: Addresses
    """(c,): start address of each block's codes."""
    row_params: NDArray[np.float32]
    """(3, n): scale, error and length of each row."""

    @classmethod
    def of(cls, chunks: Sequence[LoadedChunk]) -> Int8Blocks:
        """Create them from chunks that all have int8 codes."""
        codes = [chunk.int8 for chunk in chunks if chunk.int8 is not None]
        if len(codes) < len(chunks):
            raise ValueError("a chunk has no int8 codes")
        return cls.with_codes(
            chunks,
            code_addresses=array_addresses(code.numbers for code in codes),
            row_params=np.concatenate(
                [np.stack([code.scales, code.errors, code.lengths]) for code in codes], axis=1
            ),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """All rows that may be among the k best."""

    rows: Indices
    upper_bounds: Scores
    """Upper bound of each row's score."""
    floor: float
    """Lower bound of the k-th best score; -inf if there are fewer than k rows."""


def find_candidates(
    blocks: Int8Blocks,
    query: Int8Query,
    row_mask: NDArray[np.bool_],
    k: int,
    min_score: float,
    budget: SearchBudget,
) -> Candidates | None:
    """Find the rows that may be among the `k` best and score at least `min_score`.

    Args:
        blocks: Codes of n rows.
        query: The query.
        row_mask: (n,) bool, the rows that may be returned.
        k: Number of results.
        min_score: Minimum score, or -inf.
        budget: The deadline.

    Returns:
        The candidates; None if the deadline passed before all rows were scanned.
    """
    lower_bounds = np.full(k, -math.inf)
    rows, upper_bounds = np.empty(len(blocks), np.int64), np.empty(len(blocks))
    step = max(1, BUDGET_CHECK_BYTES // len(query.numbers))
    count = 0
    for begin in range(0, len(blocks), step):
        if budget.is_exhausted(-1):
            return None
        count = rows_above_floor(
            blocks.code_addresses,
            blocks.first_rows,
            row_mask,
            blocks.row_params,
            query.numbers,
            (query.scale, query.error, min_score),
            begin,
            min(len(blocks), begin + step),
            lower_bounds,
            rows,
            upper_bounds,
            count,
        )
    floor = max(min_score, float(lower_bounds[0]))
    above_floor = upper_bounds[:count] >= floor
    return Candidates(rows[:count][above_floor], upper_bounds[:count][above_floor], floor)
