"""Photo filter by location, capture time, place, tags and ids.

The same filter restricts a similarity search (inside the scan) and a metadata search (in SQL).
"""

from __future__ import annotations

from datetime import datetime
from string import ascii_lowercase, ascii_uppercase
from typing import Annotated
from uuid import UUID

from pydantic import AfterValidator, BaseModel, ConfigDict

from shared.geodesy import flush_to_zero, latitude_bounds, longitude_half_width

_ASCII_LOWER = str.maketrans(ascii_uppercase, ascii_lowercase)
Coordinate = Annotated[float, AfterValidator(flush_to_zero)]


class _FilterModel(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Box(_FilterModel):
    """Bounding box in degrees, bounds inclusive; `west` > `east` crosses the antimeridian.

    A pole has every longitude: a box that reaches latitude 90 contains every photo there.
    """

    south: Coordinate
    west: Coordinate
    north: Coordinate
    east: Coordinate

    def longitude_ranges(self) -> list[tuple[float, float]]:
        """Split the longitudes into ranges in [-180, 180] that don't cross the antimeridian.

        -180 and 180 are the same meridian: a range that ends there also contains the other value.
        """
        if self.west > self.east:
            return [(self.west, 180.0), (-180.0, self.east)]
        ranges = [(self.west, self.east)]
        if self.east == 180.0:
            ranges.append((-180.0, -180.0))
        if self.west == -180.0:
            ranges.append((180.0, 180.0))
        return ranges


class Circle(_FilterModel):
    """All points within `radius_m` metres (inclusive) of a point in degrees."""

    latitude: Coordinate
    longitude: Coordinate
    radius_m: float

    def bounding_box(self) -> Box:
        """Return a box that holds the circle; some of its points are farther away."""
        south, north = latitude_bounds(self.latitude, self.radius_m)
        half_width = longitude_half_width(self.latitude, self.radius_m)
        west, east = -180.0, 180.0
        if half_width is not None and half_width < 180:
            west, east = self.longitude - half_width, self.longitude + half_width
        return Box(
            south=max(south, -90.0),
            west=west + 360 if west < -180 else west,
            north=min(north, 90.0),
            east=east - 360 if east > 180 else east,
        )


class PhotoFilter(_FilterModel):
    """Conditions that a photo must meet; None or empty means no condition.

    A photo without a value does not meet a condition on that value.
    """

    near: Circle | None = None
    box: Box | None = None
    captured_after: datetime | None = None
    captured_before: datetime | None = None
    place: str | None = None
    place_under: str | None = None
    """A level of label paths, which the photo's label is or lies below."""
    tags: tuple[str, ...] = ()
    """The photo must have all of these tags."""
    tags_like: tuple[str, ...] = ()
    """Each must be a part of one of the photo's tags; ASCII letters match in either case."""
    ids: tuple[UUID, ...] | None = None
    """The photo must be one of these; an empty tuple matches no photo."""
    has_place: bool = False
    """Whether the photo must have coordinates or a place label."""

    @property
    def is_empty(self) -> bool:
        """Whether the filter has no condition."""
        return self == NO_FILTER


NO_FILTER = PhotoFilter()


def is_part_of_tag(part: str, tag: str) -> bool:
    """Whether the tag contains the part. Only ASCII letters match in either case.

    Folding of other letters differs between Python, PostgreSQL and SQLite.
    """
    return _ascii_lower(part) in _ascii_lower(tag)


def _ascii_lower(text: str) -> str:
    return text.translate(_ASCII_LOWER)
