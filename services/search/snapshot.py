"""What a generation looks like at one version: immutable, so that queries need no lock."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from datetime import UTC, datetime
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from shared.catalog.photos import PhotoFacts
from shared.chunks import Rows

EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
NEVER = np.datetime64("NaT", "us")


@dataclass(frozen=True, slots=True, eq=False)
class PhotoColumns:
    """What is known of the photo of each of a chunk's n rows: arrays of length n.

    A row without a live photo has `photo_id` None. `findable`: live, and not a labelled query.
    """

    photo_id: NDArray[np.object_]
    findable: NDArray[np.bool_]
    latitude: NDArray[np.float64]
    """Degrees; NaN where the photo has no coordinates."""
    longitude: NDArray[np.float64]
    captured_at: NDArray[np.datetime64]
    """UTC, microseconds; NaT where unknown."""
    place: NDArray[np.object_]
    tags: NDArray[np.object_]
    """A frozenset of texts a row."""

    @classmethod
    def of(cls, rows: int, facts: Iterable[tuple[int, PhotoFacts]]) -> PhotoColumns:
        """(row, photo) pairs as columns of `rows` rows; rows without a photo are dead."""
        columns = cls(
            photo_id=np.full(rows, None, dtype=object),
            findable=np.zeros(rows, dtype=bool),
            latitude=np.full(rows, np.nan),
            longitude=np.full(rows, np.nan),
            captured_at=np.full(rows, NEVER),
            place=np.full(rows, None, dtype=object),
            tags=np.full(rows, frozenset(), dtype=object),
        )
        for row, photo in facts:
            columns._set(row, photo)
        return columns

    def changed(self, changes: Mapping[UUID, PhotoFacts]) -> PhotoColumns:
        """The columns with what has changed; itself when none of the photos is here."""
        here = [(row, changes[id_]) for row, id_ in enumerate(self.photo_id) if id_ in changes]
        if not here:
            return self
        copy = PhotoColumns(*(getattr(self, column.name).copy() for column in fields(self)))
        for row, photo in here:
            copy._set(row, photo)
        return copy

    def _set(self, row: int, photo: PhotoFacts) -> None:
        self.photo_id[row] = photo.photo_id
        self.findable[row] = photo.findable
        self.latitude[row] = np.nan if photo.latitude is None else photo.latitude
        self.longitude[row] = np.nan if photo.longitude is None else photo.longitude
        self.captured_at[row] = as_microseconds(photo.captured_at)
        self.place[row] = photo.place
        self.tags[row] = frozenset(photo.tags)


def as_microseconds(when: datetime | None) -> np.datetime64:
    """An aware datetime as NumPy's UTC microseconds."""
    if when is None:
        return NEVER
    return np.datetime64(when.astimezone(UTC).replace(tzinfo=None), "us")


@dataclass(frozen=True, slots=True, eq=False)
class LoadedChunk:
    """Rows in memory, (n, dimension) float32, and what is known of their photos."""

    chunk_id: UUID
    object_key: str
    rows: Rows
    photos: PhotoColumns


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """A generation's chunks at `version` of its map; `missing` names objects that can't be read."""

    generation_id: UUID
    map_id: UUID
    version: int
    chunks: tuple[LoadedChunk, ...]
    missing: tuple[str, ...] = ()
    live_rows: int = 0
    by_key: Mapping[str, LoadedChunk] = field(default_factory=dict)
    """The loaded chunks by their object's key."""

    @property
    def resident_bytes(self) -> int:
        return sum(chunk.rows.nbytes for chunk in self.chunks)
