"""Which photos may be answered: by where, when and what they are.

The same filter narrows a similarity search (inside the scan) and a metadata search (in SQL).
"""

from __future__ import annotations

from datetime import datetime
from typing import Annotated
from uuid import UUID

from pydantic import AfterValidator, BaseModel, ConfigDict

from shared.geodesy import flush_to_zero

Coordinate = Annotated[float, AfterValidator(flush_to_zero)]


class _FilterModel(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Circle(_FilterModel):
    """Everything within `radius_m` metres (inclusive) of a point in degrees."""

    latitude: Coordinate
    longitude: Coordinate
    radius_m: float


class Box(_FilterModel):
    """Degrees, bounds inclusive. `west` > `east` crosses the antimeridian.

    A pole has every longitude: a box that reaches latitude 90 holds whatever lies there.
    """

    south: Coordinate
    west: Coordinate
    north: Coordinate
    east: Coordinate

    def longitude_ranges(self) -> list[tuple[float, float]]:
        """The longitudes as ranges that don't cross the antimeridian, in [-180, 180].

        -180 and 180 are one meridian: a range that ends there also holds the other spelling.
        """
        if self.west > self.east:
            return [(self.west, 180.0), (-180.0, self.east)]
        ranges = [(self.west, self.east)]
        if self.east == 180.0:
            ranges.append((-180.0, -180.0))
        if self.west == -180.0:
            ranges.append((180.0, 180.0))
        return ranges


class PhotoFilter(_FilterModel):
    """What is None or empty filters nothing; a photo without a value passes no filter on it."""

    near: Circle | None = None
    box: Box | None = None
    captured_after: datetime | None = None
    captured_before: datetime | None = None
    place: str | None = None
    tags: tuple[str, ...] = ()
    """A photo must carry all of them."""
    ids: tuple[UUID, ...] | None = None
    """Only these; an empty tuple lets nothing pass."""

    @property
    def is_empty(self) -> bool:
        return self == NO_FILTER


NO_FILTER = PhotoFilter()
