"""The photos of a map whose place is known, and which of them show a given place."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from uuid import UUID

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import select
from sqlalchemy.orm import Session

from shared.catalog.chunks import Descriptor
from shared.catalog.photos import Photo, PhotoRole, is_geotagged
from shared.estimate.places import PhotoLocation
from shared.geodesy import distances_m, latitude_bounds


@dataclass(frozen=True, slots=True)
class GeotaggedPhoto:
    """A described photo whose place is known."""

    photo_id: UUID
    spot: PhotoLocation
    captured_at: datetime | None


class GeotaggedPhotos:
    """Database photos by place: how many of them show one."""

    def __init__(self, photos: Sequence[GeotaggedPhoto]) -> None:
        self.photos = photos
        self._labels = Counter(p.spot.place for p in photos if p.spot.place is not None)
        on_earth = sorted(
            (p for p in photos if p.spot.latitude is not None), key=lambda p: p.spot.latitude or 0.0
        )
        self._ids = [photo.photo_id for photo in on_earth]
        self._spots = np.array(
            [(p.spot.latitude, p.spot.longitude) for p in on_earth], dtype=np.float64
        ).reshape(-1, 2)

    def count_at_place(self, spot: PhotoLocation, radius_m: float) -> int:
        """How many photos lie within `radius_m` of the spot, or bear its label: the larger count,
        so that one that does both counts once."""
        labelled = self._labels[spot.place] if spot.place is not None else 0
        return max(labelled, len(self._within(spot, radius_m)))

    def find_within(self, spot: PhotoLocation, radius_m: float) -> list[UUID]:
        """The photos that lie within `radius_m` of the spot; none where it has no coordinates."""
        return [self._ids[number] for number in self._within(spot, radius_m).tolist()]

    def _within(self, spot: PhotoLocation, radius_m: float) -> NDArray[np.int64]:
        if spot.latitude is None or spot.longitude is None:
            return np.empty(0, np.int64)
        south, north = latitude_bounds(spot.latitude, radius_m)
        first, last = np.searchsorted(self._spots[:, 0], [south, north])
        near = self._spots[first : last + 1]
        away = distances_m(spot.latitude, spot.longitude, near[:, 0], near[:, 1])
        found: NDArray[np.int64] = first + np.flatnonzero(away <= radius_m)
        return found


def read_geotagged_photos(
    session: Session, map_id: UUID, generation_id: UUID, role: PhotoRole
) -> list[GeotaggedPhoto]:
    """The live photos of a role that have a descriptor in the generation and a place, by id."""
    found = session.execute(
        select(Photo.id, Photo.latitude, Photo.longitude, Photo.place, Photo.captured_at)
        .join(Descriptor, Descriptor.photo_id == Photo.id)
        .where(
            Photo.map_id == map_id,
            Descriptor.generation_id == generation_id,
            Photo.deleted_at.is_(None),
            Photo.role == role,
            is_geotagged(),
        )
        .order_by(Photo.id)
    )
    return [GeotaggedPhoto(row[0], PhotoLocation(*row[1:4]), row[4]) for row in found]
