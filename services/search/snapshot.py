"""Immutable snapshot of a generation at one version, so that queries need no lock."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from services.search.chunk_loader import LoadedChunk
from services.search.photo_columns import JoinedColumns

if TYPE_CHECKING:  # imports numba, which takes a while to load; small maps need no codes
    from services.search.exact_rerank import RowBlocks
    from services.search.sign_code_search import SignCodeBlocks


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The loaded chunks of a generation at `version` of its map.

    `missing` names objects that can't be read, `unwritten` those that an engine lacks.
    """

    generation_id: UUID
    map_id: UUID
    version: int
    chunks: tuple[LoadedChunk, ...]
    missing: tuple[str, ...] = ()
    unwritten: frozenset[str] = frozenset()
    disk_full: bool = False
    """Whether some are missing only because the disk of the worker's cache is full."""
    resident_bytes: int = 0
    mapped_bytes: int = 0
    """Bytes of its index in memory, and in mapped files."""

    @cached_property
    def by_key(self) -> Mapping[str, LoadedChunk]:
        """Loaded chunks by object key."""
        return {chunk.object_key: chunk for chunk in self.chunks}

    @cached_property
    def photos(self) -> JoinedColumns:
        """Photo columns of all chunks, concatenated."""
        return JoinedColumns([chunk.photos for chunk in self.chunks])

    @cached_property
    def live_rows(self) -> int:
        """Number of searchable rows."""
        return int(self.photos.findable.sum())

    @property
    def dimension(self) -> int:
        """Dimension of the rows; 0 without any rows."""
        return self.chunks[0].rows.shape[1] if self.chunks else 0

    @cached_property
    def has_sign_codes(self) -> bool:
        """Whether every chunk has its sign codes."""
        return bool(self.chunks) and all(chunk.codes is not None for chunk in self.chunks)

    def prefetch_rows(self, rows: NDArray[np.int64]) -> None:
        """Advise the system that these rows are read next, where they are mapped files."""
        for chunk, row in self.photos.locate(rows):
            self.chunks[chunk].prefetch_row(row)

    @cached_property
    def row_blocks(self) -> RowBlocks:
        """Addresses of the rows, for compiled loops."""
        from services.search.exact_rerank import RowBlocks

        return RowBlocks.of(self.chunks)

    @cached_property
    def sign_code_blocks(self) -> SignCodeBlocks:
        """Addresses of the sign codes and rows; requires `has_sign_codes`."""
        from services.search.sign_code_search import SignCodeBlocks

        return SignCodeBlocks.of(self.chunks)
