"""Positions over HTTP: a photo's header, and proposals for the photos of a folder."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from PIL import Image
from PIL.ExifTags import IFD, Base

from tests.integration.in_process_api import Service
from tests.support.photos import photo_bytes
from tests.support.problems import problem

NOON = datetime(2026, 5, 1, 12, tzinfo=UTC)


def dated(name: str, seconds: float, latitude: float | None = None) -> dict[str, Any]:
    return {
        "name": name,
        "captured_at": (NOON + timedelta(seconds=seconds)).isoformat(),
        "time_zone_is_known": True,
        "camera": "Camera",
        "camera_is_unique": True,
        "latitude": latitude,
        "longitude": None if latitude is None else 7.0,
    }


def propose(service: Service, *photos: dict[str, Any], **options: Any) -> list[dict[str, Any]]:
    answer = service("POST", "/positions", json={"photos": photos, **options})
    assert answer.status_code == 200, answer.text
    proposals: list[dict[str, Any]] = answer.json()["proposals"]
    return proposals


def test_time_and_camera_are_read_from_the_begin_of_a_photo(service: Service) -> None:
    exif = Image.Exif()
    exif[Base.Model] = "Camera"
    exif.get_ifd(IFD.Exif)[Base.DateTimeOriginal] = "2026:05:01 12:00:00"
    exif.get_ifd(IFD.Exif)[Base.FocalLengthIn35mmFilm] = 27
    begin = photo_bytes(1, exif=exif)[:1500]
    octets = {"Content-Type": "application/octet-stream"}
    answer = service("POST", "/photo-headers", content=begin, headers=octets)
    assert answer.json() == {
        "captured_at": "2026-05-01T12:00:00Z",
        "time_zone_is_known": False,
        "camera": "Camera",
        "camera_is_unique": False,
        "clock_offset": None,
        "latitude": None,
        "longitude": None,
        "gps_error": None,
        "focal_length": pytest.approx(27 / 36, rel=0.2),
    }
    refused = service("POST", "/photo-headers", content=b"no photo", headers=octets)
    assert problem(refused, 422, "undecodable_photo")


def test_searches_neighbours_and_a_track_are_combined(service: Service) -> None:
    for number in range(3):
        service.upload(photo_bytes(number), latitude=45 + number / 1000, longitude=7.0)
    search = {
        "similar": [{"name": "2.jpg", "latitude": 45.002, "longitude": 7.0, "score": 0.9}],
        "circles": [{"latitude": 45.002, "longitude": 7.0, "radius_m": 100, "probability": 0.6}],
        "not_in_map": 0.02,
    }
    unknown = {**dated("unknown.jpg", 20), "camera": None, "search": search}
    between = {**dated("between.jpg", 10), "search": search}
    alone, both = propose(service, dated("a.jpg", 0, 45.0019), unknown, between)
    assert (alone["name"], alone["reason"]) == ("unknown.jpg", "looks like 2.jpg")
    assert alone["latitude"] == pytest.approx(45.002, abs=1e-4)
    assert both["probability"] > 0.9 > alone["probability"]
    assert both["reason"] == "looks like 2.jpg; taken 10 s after a.jpg"
    track = [
        {"time": (NOON + timedelta(seconds=s)).isoformat(), "latitude": 45.001, "longitude": 7.0}
        for s in (30, 0)
    ]
    (by_track,) = propose(service, dated("b.jpg", 5), track=track)
    assert by_track["latitude"] == pytest.approx(45.001, abs=1e-5)
    pose = {"latitude": 45.0021, "longitude": 7.0, "radius_68_m": 0.5, "heading": 338.0}
    (posed,) = propose(service, {**unknown, "search": {**search, "pose": pose}})
    assert posed["latitude"] == pytest.approx(45.0021, abs=1e-6)
    assert (posed["heading"], both["heading"]) == (338, None)
    assert posed["radius_68_m"] < 1
    assert posed["probability"] > 0.97
    (nothing,) = propose(service, {"name": "c.jpg"}, track=track)
    assert (nothing["latitude"], nothing["probability"]) == (None, 0)


def test_bodies_that_cannot_be_computed_are_refused(service: Service) -> None:
    half = {**dated("a.jpg", 0), "latitude": 45.0}
    many = [{"name": str(number)} for number in range(101)]
    for photos in ([half], many, [{"name": "a", "latitude": 95, "longitude": 0}]):
        answer = service("POST", "/positions", json={"photos": photos})
        assert problem(answer, 422, "invalid_field")


def test_a_folder_of_thousands_of_photos_is_one_call(service: Service) -> None:
    similar = [
        {"name": f"IMG_20260501_{number:06}.jpg", "latitude": 45.0, "longitude": 7.0, "score": 0.9}
        for number in range(50)
    ]
    search = {"similar": similar, "circles": [], "not_in_map": 0.02}
    unknown = [{**dated(f"unknown/{number}.jpg", number), "search": search} for number in range(20)]
    known = [dated(f"folder/known/{number}.jpg", number, 45.0) for number in range(9_000)]
    assert len(propose(service, *unknown, *known)) == 20
    large = service("POST", "/positions", content=b" " * 4_000_001)
    assert problem(large, 413, "body_too_large")


@pytest.mark.parametrize("path", ["/positions", "/photo-headers"])
def test_a_large_body_is_not_read_because_it_is_called_a_form(service: Service, path: str) -> None:
    form = {"Content-Type": "multipart/form-data; boundary=a"}
    answer = service("POST", path, content=b"x" * 4_000_001, headers=form)
    assert problem(answer, 413, "body_too_large")
