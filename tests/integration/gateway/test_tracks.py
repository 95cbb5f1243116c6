"""Tracks over HTTP: frames in order, again, late and from two clients, in a map that changes."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import Any

import pytest

from tests.integration.in_process_api import Service
from tests.support.photos import near_copy, photo_bytes

BEGIN = datetime(2026, 5, 1, 12, tzinfo=UTC)
STREET = range(6)
METRES_APART = 20.0
DEGREES_PER_METRE = 1 / 111_195


def time_of(number: float) -> str:
    return (BEGIN + timedelta(seconds=5 * number)).isoformat()


@pytest.fixture
def street(service: Service) -> Service:
    """A map of a street, one photo every 20 metres to the north."""
    for number in STREET:
        service.upload(
            photo_bytes(number),
            latitude=45 + number * METRES_APART * DEGREES_PER_METRE,
            longitude=7.0,
            heading=0,
        )
    service.drain()
    return service


def begin(service: Service, **params: Any) -> str:
    return str(
        service.json("POST", "/tracks", 201, json={"motion": "bicycle", **params})["track_id"]
    )


def send(service: Service, track_id: str, number: int, status: int = 202, **fields: Any) -> Any:
    """A frame of the street's photo of that number."""
    data = {"captured_at": time_of(number), **fields}
    files = {"file": (f"frame-{number}.jpg", near_copy(number))}
    return service.json("POST", f"/tracks/{track_id}/frames", status, data=data, files=files)


def ride(service: Service, track_id: str, *numbers: int) -> Any:
    for number in numbers:
        send(service, track_id, number)
    service.drain()
    return service.json("GET", f"/tracks/{track_id}")


def test_a_ride_is_tracked_frame_by_frame(street: Service) -> None:
    track_id = begin(street)
    empty = street.json("GET", f"/tracks/{track_id}")
    assert (empty["version"], empty["pending"], empty["state"], empty["frames"]) == (0, 0, None, [])
    first = send(street, track_id, 0)
    assert (first["status"], first["state"], first["version"]) == ("pending", None, 1)
    track = ride(street, track_id, 1, 2, 3, 4)
    assert (track["version"], track["pending"]) == (5, 0)
    assert [frame["status"] for frame in track["frames"]] == ["applied"] * 5
    state = track["state"]
    print(state)
    assert state == track["frames"][-1]["state"]
    assert state["status"] == "tracking"
    assert state["latitude"] == pytest.approx(45 + 80 * DEGREES_PER_METRE, abs=1e-4)
