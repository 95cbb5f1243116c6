"""Neighbours in time: which photos are of one camera, and the zones of their clocks."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import Any

import pytest

from shared.geotagging.evidence import DatedPhoto, TimeNeighbours, add_time_zones
from shared.geotagging.fusion import Proposal, propose_position

NOON = datetime(2026, 5, 1, 12, tzinfo=UTC)
HOUR = timedelta(hours=1)


def dated(name: str, seconds: float, latitude: float | None = None, **options: Any) -> DatedPhoto:
    values = {"time_zone_is_known": True, "camera": "Acme Phone", **options}
    longitude = None if latitude is None else 7.0
    time = NOON + timedelta(seconds=seconds)
    return DatedPhoto(name, time, latitude=latitude, longitude=longitude, **values)


def proposed(*photos: DatedPhoto) -> Proposal | None:
    """The proposal for the last photo."""
    position = TimeNeighbours(photos, together=False).position_of(photos[-1], 3.0)
    return propose_position(None, position, None, 100.0)


@pytest.mark.parametrize(
    ("names", "options"),
    [
        (("IMG_0012.jpg", "IMG_0013.jpg"), {}),
        (("day/IMG_0012.jpg", "day/IMG_0030 (1).jpg"), {}),
        (("20260501_120000.jpg", "a.jpg"), {"camera_is_unique": True}),
    ],
)
def test_photos_of_one_camera_are_near_each_other(
    names: tuple[str, str], options: dict[str, Any]
) -> None:
    found = proposed(dated(names[0], 0, 45.0, **options), dated(names[1], 5, **options))
    assert found is not None
    assert found.probability > 0.97
    assert found.reason == f"taken 5 s after {names[0]}"


@pytest.mark.parametrize(
    "names",
    [
        ("20260501_120000.jpg", "20260501_120005.jpg"),
        ("IMG_0012.jpg", "IMG_4711.jpg"),
        ("IMG_0013.jpg", "IMG_0012.jpg"),
        ("anna/IMG_0012.jpg", "ben/IMG_0013.jpg"),
        ("a.jpg", "b.jpg"),
    ],
)
def test_photos_of_one_model_may_be_of_two_phones(names: tuple[str, str]) -> None:
    found = proposed(dated(names[0], 0, 45.0), dated(names[1], 5))
    assert found is not None
    assert 0.4 < found.probability < 0.7
    assert found.radius_68_m > 200
    assert found.reason.endswith("perhaps by another camera of the same model")


def test_two_phones_that_count_the_same_numbers_are_no_series() -> None:
    others = [dated("x/IMG_0011.jpg", -60, 45.0), dated("x/IMG_0011 (1).jpg", 30, 45.1)]
    found = proposed(*others, dated("x/IMG_0012.jpg", 40))
    assert found is not None
    assert found.probability < 0.7


def test_known_cameras_of_one_model_are_told_apart() -> None:
    first = dated("IMG_1.jpg", 0, 45.0, camera="Acme Phone Anna", camera_is_unique=True)
    assert proposed(first, dated("IMG_2.jpg", 5)) is None
    other = dated("IMG_2.jpg", 5, camera="Acme Phone Ben", camera_is_unique=True)
    assert proposed(first, other) is None


def test_a_clock_without_a_zone_has_that_of_the_nearest_photo_by_the_same_camera() -> None:
    photos = [
        dated("1.jpg", 0, 45.0, clock_offset=HOUR),
        dated("2.jpg", 3660, time_zone_is_known=False),
        dated("3.jpg", 24 * 3600, 45.0, clock_offset=2 * HOUR),
        dated("4.jpg", 26 * 3600 + 60, time_zone_is_known=False),
        dated("5.jpg", 3660, time_zone_is_known=False, camera="another"),
        dated("6.jpg", 3660, time_zone_is_known=False, camera=None),
    ]
    zoned = add_time_zones(photos)
    assert [each.time and (each.time - NOON).total_seconds() for each in zoned] == [
        *(0, 60, 24 * 3600, 24 * 3600 + 60, 3660, 3660),
    ]
    assert [each.time_zone_is_known for each in zoned] == [True, True, True, True, False, False]
    neighbours = TimeNeighbours(zoned, together=False)
    assert neighbours.why_unknown(zoned[4], None).endswith("the time zone of its clock is missing")
    assert neighbours.why_unknown(zoned[1], None) == "nothing is known about its place"
