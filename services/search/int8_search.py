"""Exact top-k by int8 codes: no row is left out that could be in the answer, whatever it holds.

1. The product of each row's code with the query's is its score to within a bound
   (`shared.codes.int8_codes`). The k-th highest score less its bound is a floor for the answer.
2. Rows whose score plus bound reaches the floor are compared exactly, the highest first, until no
   other can reach the k-th exact score.

Nothing here is likely: every error is bounded by the lengths of what was rounded away.
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

BUDGET_CHECK_BYTES = (
    1 << 28
)  # of codes between two looks at the clock: about a hundredth of a second


@dataclass(frozen=True, slots=True, eq=False)
class Int8Blocks(RowBlocks):
    """Where the int8 codes and the rows of n photos lie, in c blocks."""

    code_addresses: Addresses
    """(c,): where the block's bytes begin."""
    row_params: NDArray[np.float32]
    """(3, n): scale, error and length of each row."""

    @classmethod
    def of(cls, chunks: Sequence[LoadedChunk]) -> Int8Blocks:
        """Those of chunks that have int8 codes."""
        codes = [chunk.int8 for chunk in chunks if chunk.int8 is not None]
        if len(codes) < len(chunks):
            raise ValueError("a chunk has no int8 codes")
        rows = RowBlocks.of(chunks)
        return cls(
            dimension=rows.dimension,
            first_rows=rows.first_rows,
            row_addresses=rows.row_addresses,
            keep_alive=rows.keep_alive,
            code_addresses=array_addresses(code.numbers for code in codes),
            row_params=np.concatenate(
                [np.stack([code.scales, code.errors, code.lengths]) for code in codes], axis=1
            ),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """Every row that may be among the k best."""

    rows: Indices
    upper_bounds: Scores
    """What each scores at most."""
    floor: float
    """What the k-th best scores at least; -inf where there are fewer."""


def find_candidates(
    blocks: Int8Blocks,
    query: Int8Query,
    row_mask: NDArray[np.bool_],
    k: int,
    min_score: float,
    budget: SearchBudget,
) -> Candidates | None:
    """Of the rows asked for, (n,) bool, those that may be among the `k` best and score at least
    `min_score`; None when the time is over before all were looked at."""
    certain = np.full(k, -math.inf)
    rows, reach = np.empty(len(blocks), np.int64), np.empty(len(blocks))
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
            certain,
            rows,
            reach,
            count,
        )
    floor = max(min_score, float(certain[0]))
    near = reach[:count] >= floor
    return Candidates(rows[:count][near], reach[:count][near], floor)
