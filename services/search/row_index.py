"""What a search worker searches: the interface of `MemoryIndex` and `MilvusIndex`."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any, Protocol
from uuid import UUID

from shared.search_api.protocol import IndexPart, LoadedGeneration, SearchRequest, SearchResponse
from shared.storage.chunks import Row


class IndexSnapshot(Protocol):
    """What can be searched of a generation at `version` of its map. Immutable."""

    @property
    def generation_id(self) -> UUID: ...
    @property
    def version(self) -> int: ...
    @property
    def missing(self) -> tuple[str, ...]:
        """Objects whose rows are not searched."""

    @property
    def unreadable(self) -> Collection[str]:
        """Those that can't be read."""

    @property
    def disk_full(self) -> bool: ...
    @property
    def parts(self) -> tuple[IndexPart, ...]: ...
    @property
    def live_rows(self) -> int: ...
    @property
    def held(self) -> LoadedGeneration: ...
    def read_row(self, object_key: str, row: int) -> Row | None:
        """Return a row; None if it is not held, IndexError if its object has no such row."""


class RowIndex(Protocol):
    """The rows of all generations; thread-safe, one `sync` of a generation at a time."""

    changes_alone: bool
    """Whether it may change without a change of the catalog"""

    @property
    def recalls(self) -> Mapping[UUID, float]:
        """Measured recall of an approximate index, by generation."""

    def sync(self, generation_id: UUID, old: Any) -> IndexSnapshot | None:
        """Bring a generation up to date; None if it no longer exists."""

    def needs_sync(self, snapshot: Any) -> bool:
        """Whether a snapshot of the map's current version is to be made again."""

    def search(self, snapshot: Any, query: Row, request: SearchRequest) -> SearchResponse:
        """Return the most similar rows of a snapshot."""

    def list_held(self) -> Sequence[Any]:
        """Return what is held of any generation, outside of this process."""

    def remove_others(self, held: Sequence[Any], generation_ids: Collection[UUID]) -> None:
        """Remove what is held of other generations."""
