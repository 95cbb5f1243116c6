"""What is asked of a search worker and what it answers.

A query is a reference to one descriptor row in the object store, never the vector itself: the
gateway stays free of vectors. In one process the port is a call (`services.search.worker`);
between machines it is HTTP, with a map's slots spread over shards (`shared.search_api.client`).

Over HTTP a message leaves out what has its default (`as_json`): whoever is of the release before
understands everything that it could have been told.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Protocol
from uuid import UUID

from pydantic import BaseModel, ConfigDict, Field

from shared.config.shards import SINGLE_SHARD
from shared.search_api.photo_filter import NO_FILTER, PhotoFilter

EXHAUSTIVE = "exhaustive"  # every row was compared exactly
BOUND = "bound"  # no row that was left out can reach the answer, whatever it holds
STATISTICAL = "statistical"  # the same but for a chance of about 1 in 10^8
NONE = "none"  # the search ended early, or lacks a part of the map: better rows may be missing
CERTIFICATES = (EXHAUSTIVE, BOUND, STATISTICAL, NONE)
"""How an answer can have been reached, strongest first."""


class Mode(StrEnum):
    """How to search."""

    AUTO = "auto"  # whichever reads less
    DENSE = "dense"  # compare every row exactly
    DETERMINISTIC = "deterministic"  # leave nothing to chance: `exhaustive` or `bound`


class _Message(BaseModel):
    # Of an answer, what a newer worker adds is passed over.
    model_config = ConfigDict(frozen=True)

    def as_json(self) -> str:
        """Without defaults: what is not asked for needs no one who understands it."""
        return self.model_dump_json(exclude_defaults=True)


class SearchRequest(_Message):
    """The `k` rows of `generation_id` that are most similar to row `row` of object `object_key`,
    of those whose photos pass the filter `photos`.

    The worker first catches up with `min_version` of the map, so that whoever just saw a photo
    indexed or deleted sees it in the answer. `exclude` names photos that must not be answered
    (the query itself).

    `word_weights`, one for each word of the generation's vocabulary, multiply the query's words,
    and the rows are ranked by that; `min_score` still means the plain cosine. They come by value,
    so that all shards of one answer rank by the same ones.
    """

    # What is asked has to be understood: a filter that is passed over would be a wrong answer.
    model_config = ConfigDict(extra="forbid")

    map_id: UUID
    generation_id: UUID
    object_key: str
    row: int = Field(ge=0)
    min_version: int = Field(ge=0)
    k: int = Field(ge=1)
    photos: PhotoFilter = NO_FILTER
    min_score: float | None = None
    exclude: tuple[UUID, ...] = ()
    mode: Mode = Mode.AUTO
    most_rows: int | None = Field(None, ge=0)
    """Give up once so many rows were compared exactly, and say so (`none`)."""
    most_seconds: float | None = Field(None, gt=0)
    """Give up after this time."""
    word_weights: tuple[float, ...] = ()


class SearchHit(_Message):
    photo_id: UUID
    score: float
    """Cosine similarity in [-1, 1]."""
    weighted_score: float | None = None
    """Cosine similarity to the weighted query; None where the ranking is the plain one: without
    weights, or where no word of the query has any."""

    @property
    def ranked_by(self) -> float:
        """The score that decides the order."""
        return self.score if self.weighted_score is None else self.weighted_score


class SearchResponse(_Message):
    """`hits` are sorted by what ranks them (`Hit.ranked_by`), highest first, ties by photo id."""

    hits: tuple[SearchHit, ...]
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


class ReplicationLag(_Message):
    """How far a snapshot is behind its map. `seconds` since it was last known to be level."""

    versions: int
    seconds: float
    answers: bool
    """Whether the generation is the active one; False for one that is only being built."""


class IndexPart(_Message):
    """One part of what a generation is searched by: a level of its codes, or its rows."""

    name: str
    size_bytes: int
    resident: bool
    """Held in memory; else mapped from files, of which the system keeps what it has room for."""


class LoadedGeneration(_Message):
    """What is held of one generation."""

    rows: int
    """With those of deleted photos."""
    dimension: int
    parts: tuple[IndexPart, ...]


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

    shard: str = str(SINGLE_SHARD)
    rows: int
    resident_bytes: int
    mapped_bytes: int = 0
    """What is not resident."""
    versions: dict[UUID, int]
    held: dict[UUID, LoadedGeneration] = {}
    """Empty for several workers together."""
    incomplete: tuple[UUID, ...] = ()
    """Generations of which a chunk can't be read."""
    missing: tuple[str, ...]
    """The chunks that can't be read."""
    lags: dict[UUID, ReplicationLag] = {}
    """Empty where no one follows the catalog."""
    devices: tuple[DeviceStatus, ...] = ()
    """Empty where the CPU does all."""
    away: tuple[str, ...] = ()
    """Shards of which no worker answers, as `missing` of an answer names them."""

    @property
    def loaded(self) -> dict[UUID, int]:
        """The versions of the generations that are there without a gap."""
        return {key: value for key, value in self.versions.items() if key not in self.incomplete}


class SearchBackend(Protocol):
    """The gateway's view of the search tier. Raises Unavailable when it can't keep up."""

    def search(self, request: SearchRequest) -> SearchResponse: ...

    def status(self) -> SearchStatus: ...
