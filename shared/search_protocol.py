"""What is asked of a search worker and what it answers.

A query is a reference to one descriptor row in the object store, never the vector itself: the
gateway stays free of vectors. In one process the port is a call; between machines it is HTTP.
"""

from __future__ import annotations

from typing import Protocol
from uuid import UUID

from pydantic import BaseModel, ConfigDict, Field

from shared.photo_filter import EVERYTHING, PhotoFilter


class _Message(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class SearchRequest(_Message):
    """The `k` rows of `generation_id` that are most similar to row `row` of object `object_key`,
    of those whose photos pass the filter `photos`.

    The worker first catches up with `min_version` of the map, so that whoever just saw a photo
    indexed or deleted sees it in the answer. `exclude` names photos that must not be answered
    (the query itself).
    """

    map_id: UUID
    generation_id: UUID
    object_key: str
    row: int = Field(ge=0)
    min_version: int = Field(ge=0)
    k: int = Field(ge=1)
    photos: PhotoFilter = EVERYTHING
    min_score: float | None = None
    exclude: tuple[UUID, ...] = ()


class Hit(_Message):
    photo_id: UUID
    score: float
    """Cosine similarity in [-1, 1]."""


class SearchResponse(_Message):
    """`hits` are sorted by score, highest first, ties by photo id."""

    hits: tuple[Hit, ...]
    certificate: str
    """How the answer was reached; `exhaustive`: every row was compared exactly."""
    rows_scanned: int
    rows_reranked: int
    snapshot_version: int
    missing: tuple[str, ...] = ()
    """Objects that could not be read and whose photos can't be in the answer."""


class SearchStatus(_Message):
    """How far a worker has followed: rows and bytes in memory, version by generation."""

    rows: int
    resident_bytes: int
    versions: dict[UUID, int]
    missing: tuple[str, ...]


class SearchPort(Protocol):
    """The gateway's view of the search tier. Raises Unavailable when it can't keep up."""

    def search(self, request: SearchRequest) -> SearchResponse: ...

    def status(self) -> SearchStatus: ...
