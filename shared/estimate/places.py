"""When two photos show the same place: near each other, or under one label."""

from __future__ import annotations

from dataclasses import dataclass

from shared.geodesy import distance_m

# Farther away than this, or under another label, is certainly another place. Between the radius
# that counts as right and this lies what is neither.
DIFFERENT_PLACE_M = 100.0


@dataclass(frozen=True, slots=True)
class PhotoLocation:
    """Where a photo was taken, as far as it is known; coordinates come in pairs, in degrees."""

    latitude: float | None
    longitude: float | None
    place: str | None

    @property
    def is_known(self) -> bool:
        return self.latitude is not None or self.place is not None


def distance_between_m(one: PhotoLocation, other: PhotoLocation) -> float | None:
    """None where one of them has no coordinates."""
    if one.latitude is None or one.longitude is None:
        return None
    if other.latitude is None or other.longitude is None:
        return None
    return distance_m(one.latitude, one.longitude, other.latitude, other.longitude)


def is_same_place(one: PhotoLocation, other: PhotoLocation, radius_m: float) -> bool:
    """Within `radius_m` of each other, or under one label."""
    if one.place is not None and one.place == other.place:
        return True
    away = distance_between_m(one, other)
    return away is not None and away <= radius_m


def is_different_place(one: PhotoLocation, other: PhotoLocation) -> bool:
    """Certainly another place: another label or more than 100 m away, and nothing against it."""
    away = distance_between_m(one, other)
    labels_differ = one.place is not None and other.place is not None and one.place != other.place
    if one.place is not None and one.place == other.place:
        return False
    return labels_differ if away is None else away > DIFFERENT_PLACE_M
