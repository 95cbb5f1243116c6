"""Where the rows of a snapshot lie in memory, for the compiled loops."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.search.loaded_chunk import LoadedChunk

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
