"""When two photos show the same place: near each other, or under one label."""

from __future__ import annotations

from dataclasses import dataclass

from shared.geodesy import distance_m

# Farther away than this, or under another label, is certainly another place. Between the radius
# that counts as right and this lies what is neither.
ELSEWHERE_M = 100.0


@dataclass(frozen=True, slots=True)
class Spot:
    """Where a photo was taken, as far as it is known; coordinates come in pairs, in degrees."""

    latitude: float | None
    longitude: float | None
    place: str | None

    @property
    def is_known(self) -> bool:
        return self.latitude is not None or self.place is not None


def metres_between(one: Spot, other: Spot) -> float | None:
    """None where one of them has no coordinates."""
    if one.latitude is None or one.longitude is None:
        return None
    if other.latitude is None or other.longitude is None:
        return None
    return distance_m(one.latitude, one.longitude, other.latitude, other.longitude)


def same_place(one: Spot, other: Spot, radius_m: float) -> bool:
    """Within `radius_m` of each other, or under one label."""
    if one.place is not None and one.place == other.place:
        return True
    away = metres_between(one, other)
    return away is not None and away <= radius_m


def elsewhere(one: Spot, other: Spot) -> bool:
    """Certainly another place: another label or more than 100 m away, and nothing against it."""
    away = metres_between(one, other)
    labels_differ = one.place is not None and other.place is not None and one.place != other.place
    if one.place is not None and one.place == other.place:
        return False
    return labels_differ if away is None else away > ELSEWHERE_M
