"""What a generation looks like at one version: immutable, so that queries need no lock."""

from __future__ import annotations

from dataclasses import dataclass
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from shared.chunks import Rows


@dataclass(frozen=True, slots=True, eq=False)
class LoadedChunk:
    """Rows in memory. `photo_ids[i]` is the photo of row i; dead rows have `alive[i]` False."""

    chunk_id: UUID
    object_key: str
    rows: Rows
    photo_ids: NDArray[np.object_]
    alive: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """A generation's chunks at `version` of its map; `missing` names objects that can't be read."""

    generation_id: UUID
    map_id: UUID
    version: int
    chunks: tuple[LoadedChunk, ...]
    missing: tuple[str, ...] = ()
    live_rows: int = 0

    @property
    def resident_bytes(self) -> int:
        return sum(chunk.rows.nbytes for chunk in self.chunks)

    def chunk_at(self, object_key: str) -> LoadedChunk | None:
        """The loaded chunk that lies under `object_key`."""
        return next((chunk for chunk in self.chunks if chunk.object_key == object_key), None)
