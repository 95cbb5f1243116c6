"""A map of photos at angles whose figures can be computed by hand."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import Any

from shared.catalog.photos import PhotoRole
from tests.integration.evaluated_map import Seen, metres_north

NOON = datetime(2024, 5, 6, 12, tzinfo=UTC)
HOUR = timedelta(hours=1)


def at(latitude: float, metres: float = 0, **columns: Any) -> dict[str, Any]:
    """Taken on a meridian, some metres north of a latitude."""
    return {"latitude": latitude + metres_north(metres), "longitude": 7.0, **columns}


def query(**columns: Any) -> dict[str, Any]:
    return {"role": PhotoRole.QUERY, **columns}


# By angle; every ranking of a photo is the others by their distance round the circle. Right means
# within 25 m, or the same label.
STREETS: list[Seen] = [
    (0, at(0)),  # its place comes second (B before it): R@5
    (10, at(0, 24)),  # second as well: R@5
    (4, at(1)),  # its place comes behind all that is near: not even among ten
    (100, at(1, 10)),  # third, after 50 and 10: R@5
    (50, at(2, place="yard")),  # alone, and counted once though it has both
    (200, {"place": "hall"}),  # first: R@1
    (201, {"place": "hall", **at(30)}),  # first, by the label; it also has coordinates
    (300, at(3)),  # six strangers lie between the two: R@10
    (312, at(3, 24.9)),
    *((301 + n, at(10 + n)) for n in range(6)),  # each alone
]
WITHOUT_PLACE: list[Seen] = [(150, {}), (340, {})]  # found, but nothing to ask about
