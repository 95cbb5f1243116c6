"""What is asked of a search worker and what it answers.

A query is a reference to one descriptor row in the object store, never the vector itself: the
gateway stays free of vectors. In one process the port is a call (`services.search.worker`);
between machines it is HTTP, with a map's slots spread over shards (`shared.search_http`).
"""

from __future__ import annotations

from enum import StrEnum
from typing import Protocol
from uuid import UUID

from pydantic import BaseModel, ConfigDict, Field

from shared.photo_filter import EVERYTHING, PhotoFilter
from shared.shards import WHOLE

EXHAUSTIVE = "exhaustive"  # every row was compared exactly
BOUND = "bound"  # no row that was left out can reach the answer, whatever it holds
STATISTICAL = "statistical"  # the same but for a chance of about 1 in 10^8
NONE = "none"  # the search ended early: better rows may be missing
CERTIFICATES = (EXHAUSTIVE, BOUND, STATISTICAL, NONE)
"""How an answer can have been reached, strongest first."""


class Mode(StrEnum):
    """How to search."""

    AUTO = "auto"  # whichever reads less
    DENSE = "dense"  # compare every row exactly
    DETERMINISTIC = "deterministic"  # leave nothing to chance: `exhaustive` or `bound`


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
    mode: Mode = Mode.AUTO
    most_rows: int | None = Field(None, ge=0)
    """Give up once so many rows were compared exactly, and say so (`none`)."""
    most_seconds: float | None = Field(None, gt=0)
    """Give up after this time."""


class Hit(_Message):
    photo_id: UUID
    score: float
    """Cosine similarity in [-1, 1]."""


class SearchResponse(_Message):
    """`hits` are sorted by score, highest first, ties by photo id."""

    hits: tuple[Hit, ...]
    certificate: str
    """How the answer was reached, one of CERTIFICATES."""
    certified_k: int = 0
    """So many of the first hits are certain: all of them, unless the search ended early."""
    rows_scanned: int
    rows_reranked: int
    """Of them, those whose whole rows were read."""
    max_z: float | None = None
    """The largest error of an estimate from codes, in its standard deviations; None without."""
    snapshot_version: int
    missing: tuple[str, ...] = ()
    """Whose photos can't be in the answer: objects that could not be read, and shards (`shard
    1/3`) of which no worker answered."""


class Lag(_Message):
    """How far a snapshot is behind its map. `seconds` since it was last known to be level."""

    versions: int
    seconds: float
    answers: bool
    """Whether the generation is the active one; False for one that is only being built."""


class DeviceStatus(_Message):
    """A GPU that a worker searches on."""

    name: str
    resident_bytes: int
    """Of descriptors in its memory."""
    generations: dict[UUID, str]
    """Those that are searched there, as `float16` rows or `int8` codes; others by the CPU."""
    failure: str | None = None
    """What went wrong last: since then the CPU searches, until the next try."""


class SearchStatus(_Message):
    """How far a worker has followed: rows and bytes in memory, version by generation.

    Of several workers together: the sums, and the least version that every shard has.
    """

    shard: str = str(WHOLE)
    rows: int
    resident_bytes: int
    versions: dict[UUID, int]
    incomplete: tuple[UUID, ...] = ()
    """Generations of which a chunk can't be read."""
    missing: tuple[str, ...]
    """The chunks that can't be read."""
    lags: dict[UUID, Lag] = {}
    """Empty where no one follows the catalog."""
    devices: tuple[DeviceStatus, ...] = ()
    """Empty where the CPU does all."""
    away: tuple[str, ...] = ()
    """Shards of which no worker answers, as `missing` of an answer names them."""

    @property
    def loaded(self) -> dict[UUID, int]:
        """The versions of the generations that are there without a gap."""
        return {key: value for key, value in self.versions.items() if key not in self.incomplete}


class SearchPort(Protocol):
    """The gateway's view of the search tier. Raises Unavailable when it can't keep up."""

    def search(self, request: SearchRequest) -> SearchResponse: ...

    def status(self) -> SearchStatus: ...
