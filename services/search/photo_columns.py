"""Photo columns: the filterable values of photos, one entry per row, and filters as row masks."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from datetime import UTC, datetime
from functools import cached_property
from typing import Any
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from shared.catalog.photos import PhotoFilterValues
from shared.geodesy import distances_m
from shared.place_paths import is_within_level
from shared.search_api.photo_filter import Box, PhotoFilter, is_part_of_tag

EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
UNKNOWN_TIME = np.datetime64("NaT", "us")
LOW_64_BITS = (1 << 64) - 1


@dataclass(frozen=True, eq=False)
class PhotoColumns:
    """Values of the photos of a chunk's n rows, as arrays of length n.

    A row without a live photo has `photo_id` None. `findable` rows have a live photo that is not a
    labelled query.
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
    """A frozenset of str for each row."""

    @classmethod
    def of(cls, rows: int, photos_by_row: Iterable[tuple[int, PhotoFilterValues]]) -> PhotoColumns:
        """Build columns of `rows` rows from (row, photo) pairs; rows without a photo are dead."""
        columns = cls(
            photo_id=np.full(rows, None, dtype=object),
            findable=np.zeros(rows, dtype=bool),
            latitude=np.full(rows, np.nan),
            longitude=np.full(rows, np.nan),
            captured_at=np.full(rows, UNKNOWN_TIME),
            place=np.full(rows, None, dtype=object),
            tags=np.full(rows, frozenset(), dtype=object),
        )
        for row, photo in photos_by_row:
            columns._set_row(row, photo)
        return columns

    def __len__(self) -> int:
        return len(self.findable)

    @cached_property
    def id_low_bits(self) -> NDArray[np.uint64]:
        """Low 64 bits of each photo id, almost all of them random; 0 for dead rows."""
        low = (0 if id_ is None else id_.int & LOW_64_BITS for id_ in self.photo_id)
        return np.fromiter(low, np.uint64, len(self.photo_id))

    def ids(self, rows: NDArray[np.int64]) -> list[UUID | None]:
        """Return the photo ids of these rows; None for dead rows."""
        return list(self.photo_id[rows])

    @cached_property
    def rows_by_tag(self) -> Mapping[str, NDArray[np.int64]]:
        """Ascending rows of each tag."""
        return _group_rows((tag, row) for row, tags in enumerate(self.tags) for tag in tags)

    @cached_property
    def rows_by_place(self) -> Mapping[str, NDArray[np.int64]]:
        """Ascending rows of each place label."""
        return _group_rows(
            (place, row) for row, place in enumerate(self.place) if place is not None
        )

    @cached_property
    def has_place(self) -> NDArray[np.bool_]:
        """Which rows have coordinates or a place label."""
        labelled = np.fromiter((place is not None for place in self.place), bool, len(self.place))
        return labelled | ~np.isnan(self.latitude)

    def with_changes(self, changes: Mapping[UUID, PhotoFilterValues]) -> PhotoColumns:
        """Return the columns with changes applied; itself if none of the photos is in the chunk."""
        rows = _find_rows(self, changes)
        if not len(rows):
            return self
        copy = PhotoColumns(*(getattr(self, column.name).copy() for column in fields(self)))
        for row in rows.tolist():
            copy._set_row(row, changes[self.photo_id[row]])
        return copy

    def _set_row(self, row: int, photo: PhotoFilterValues) -> None:
        self.photo_id[row] = photo.photo_id
        self.findable[row] = photo.findable
        self.latitude[row] = np.nan if photo.latitude is None else photo.latitude
        self.longitude[row] = np.nan if photo.longitude is None else photo.longitude
        self.captured_at[row] = _to_datetime64(photo.captured_at)
        self.place[row] = photo.place
        self.tags[row] = frozenset(photo.tags)


def _joined(column: str, dtype: Any) -> cached_property[NDArray[Any]]:
    """Return a property that concatenates the column of the parts on first use."""

    def join(self: JoinedColumns) -> NDArray[Any]:
        empty = np.empty(0, dtype)  # without parts
        return np.concatenate([empty, *(getattr(part, column) for part in self.parts)])

    return cached_property(join)


@dataclass(frozen=True, eq=False)
class JoinedColumns:
    """Concatenated columns of several chunks."""

    parts: Sequence[PhotoColumns]

    findable = _joined("findable", np.bool_)
    latitude = _joined("latitude", np.float64)
    longitude = _joined("longitude", np.float64)
    captured_at = _joined("captured_at", UNKNOWN_TIME.dtype)
    id_low_bits = _joined("id_low_bits", np.uint64)
    has_place = _joined("has_place", np.bool_)

    def __len__(self) -> int:
        return int(self.first_rows[-1])

    @cached_property
    def first_rows(self) -> NDArray[np.int64]:
        """(chunks + 1,): number of each chunk's first row; the last is the number of rows."""
        return np.cumsum([0, *(len(part) for part in self.parts)])

    @cached_property
    def rows_by_tag(self) -> Mapping[str, NDArray[np.int64]]:
        return _JoinedRowIndex([part.rows_by_tag for part in self.parts], self.first_rows)

    @cached_property
    def rows_by_place(self) -> Mapping[str, NDArray[np.int64]]:
        return _JoinedRowIndex([part.rows_by_place for part in self.parts], self.first_rows)

    def locate(self, rows: NDArray[np.int64]) -> Iterator[tuple[int, int]]:
        """Yield the chunk, and the row in it, of each row."""
        chunks = np.searchsorted(self.first_rows, rows, side="right") - 1
        rows_in_chunk = rows - self.first_rows[chunks]
        return zip(chunks.tolist(), rows_in_chunk.tolist(), strict=True)

    def ids(self, rows: NDArray[np.int64]) -> list[UUID | None]:
        """Return the photo ids of these rows; None for dead rows."""
        return [self.parts[chunk].photo_id[row] for chunk, row in self.locate(rows)]


class _JoinedRowIndex(Mapping[str, NDArray[np.int64]]):
    """Index from a text to rows, over several chunks; looked up chunk by chunk."""

    def __init__(
        self, parts: list[Mapping[str, NDArray[np.int64]]], first_rows: NDArray[np.int64]
    ) -> None:
        self._parts = parts
        self._first_rows = first_rows

    def __getitem__(self, text: str) -> NDArray[np.int64]:
        rows = [
            part[text] + first_row
            for part, first_row in zip(self._parts, self._first_rows, strict=False)
            if text in part
        ]
        if not rows:
            raise KeyError(text)
        return np.concatenate(rows)

    def __iter__(self) -> Iterator[str]:
        return iter(set().union(*self._parts))

    def __len__(self) -> int:
        return len(set().union(*self._parts))


AnyPhotoColumns = PhotoColumns | JoinedColumns


def _find_rows(photos: AnyPhotoColumns, ids: Collection[UUID]) -> NDArray[np.int64]:
    """Return the rows of these photos in ascending order."""
    low_bits = np.fromiter((id_.int & LOW_64_BITS for id_ in ids), np.uint64, len(ids))
    matches = np.flatnonzero(np.isin(photos.id_low_bits, low_bits))
    id_set = frozenset(ids)
    exact = np.fromiter((id_ in id_set for id_ in photos.ids(matches)), bool, len(matches))
    rows: NDArray[np.int64] = matches[exact]
    return rows


def _group_rows(pairs: Iterable[tuple[str, int]]) -> dict[str, NDArray[np.int64]]:
    rows_by_text: dict[str, list[int]] = {}
    for text, row in pairs:
        rows_by_text.setdefault(text, []).append(row)
    return {text: np.array(rows, np.int64) for text, rows in rows_by_text.items()}


def _to_datetime64(when: datetime | None) -> np.datetime64:
    """Convert an aware datetime to NumPy's UTC microseconds; None becomes NaT."""
    if when is None:
        return UNKNOWN_TIME
    return np.datetime64(when.astimezone(UTC).replace(tzinfo=None), "us")


RowMask = NDArray[np.bool_]
NO_ROWS = np.empty(0, np.int64)


def build_row_mask(
    photos: AnyPhotoColumns, photo_filter: PhotoFilter, exclude: Collection[UUID]
) -> RowMask:
    """Return the (n,) bool mask of findable photos that pass the filter and are not excluded.

    It selects the same photos as `services.gateway.photo_search.filter_conditions` does in SQL.
    Conditions that use an index are applied first; distances are computed for the remaining rows
    only.
    """
    mask = photos.findable.copy()
    if photo_filter.ids is not None:
        mask &= _mask_of_rows(_find_rows(photos, photo_filter.ids), len(mask))
    if photo_filter.has_place:
        mask &= photos.has_place
    if photo_filter.place is not None:
        mask &= _mask_of_rows(photos.rows_by_place.get(photo_filter.place, NO_ROWS), len(mask))
    if photo_filter.place_under is not None:
        level = photo_filter.place_under
        under = [
            rows for place, rows in photos.rows_by_place.items() if is_within_level(place, level)
        ]
        mask &= _mask_of_rows(np.concatenate([NO_ROWS, *under]), len(mask))
    for tag in photo_filter.tags:
        mask &= _mask_of_rows(photos.rows_by_tag.get(tag, NO_ROWS), len(mask))
    for part in photo_filter.tags_like:
        like = [rows for tag, rows in photos.rows_by_tag.items() if is_part_of_tag(part, tag)]
        mask &= _mask_of_rows(np.concatenate([NO_ROWS, *like]), len(mask))
    if exclude:
        mask[_find_rows(photos, exclude)] = False
    if photo_filter.captured_after is not None:
        mask &= photos.captured_at >= _to_datetime64(photo_filter.captured_after)
    if photo_filter.captured_before is not None:
        mask &= photos.captured_at <= _to_datetime64(photo_filter.captured_before)
    if photo_filter.box is not None:
        mask &= _in_box(photos, photo_filter.box)
    if photo_filter.near is not None:
        circle = photo_filter.near
        remaining = np.flatnonzero(mask)
        distances = distances_m(
            circle.latitude,
            circle.longitude,
            photos.latitude[remaining],
            photos.longitude[remaining],
        )
        mask[remaining] = distances <= circle.radius_m  # False for NaN: without coordinates
    return mask


def _in_box(photos: AnyPhotoColumns, box: Box) -> RowMask:
    longitude = np.abs(photos.latitude) == 90.0
    for west, east in box.longitude_ranges():
        longitude |= (photos.longitude >= west) & (photos.longitude <= east)
    inside: RowMask = (photos.latitude >= box.south) & (photos.latitude <= box.north) & longitude
    return inside


def _mask_of_rows(rows: NDArray[np.int64], count: int) -> RowMask:
    mask = np.zeros(count, bool)
    mask[rows] = True
    return mask
