"""Uploads: what is taken, what is refused and why, and that refusals leave nothing behind."""

from __future__ import annotations

import hashlib
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from PIL import Image
from PIL.ExifTags import GPS, IFD

from tests.support.photos import photo_bytes
from tests.support.problems import field_refused, problem
from tests.support.server import ServerProcess
from tests.support.waiting import wait_until

UPLOAD = "/api/v1/upload"


def stored(server: ServerProcess) -> set[Path]:
    """Every original in the object store."""
    return set((server.home / "objects" / "originals").iterdir())


def check_nothing_is_left(server: ServerProcess, before: set[Path]) -> None:
    """The store is as it was, and what was half written is gone."""
    assert stored(server) == before
    # Others write there, but not for long.
    wait_until(lambda: not list((server.home / "objects" / ".partial").iterdir()), 10)


def photo(server: ServerProcess, file_id: str) -> dict[str, Any]:
    answer = server.client.get(f"/api/v1/uploads/{file_id}")
    assert answer.status_code == 200, answer.text
    found: dict[str, Any] = answer.json()
    return found


def with_gps(number: int) -> bytes:
    """A photo whose EXIF says 45 30' N, 7 15' W, heading 90, 2024-05-01 10:20:30 UTC."""
    exif = Image.Exif()
    exif.get_ifd(IFD.GPSInfo).update(
        {
            GPS.GPSLatitudeRef: "N",
            GPS.GPSLatitude: (45.0, 30.0, 0.0),
            GPS.GPSLongitudeRef: "W",
            GPS.GPSLongitude: (7.0, 15.0, 0.0),
            GPS.GPSImgDirection: 90.0,
            GPS.GPSDateStamp: "2024:05:01",
            GPS.GPSTimeStamp: (10.0, 20.0, 30.0),
        }
    )
    return photo_bytes(number, exif=exif)


# --- what is taken ---------------------------------------------------------------------------


def test_an_upload_is_acknowledged_with_a_job_to_poll(server: ServerProcess) -> None:
    data = photo_bytes(1)
    answer = server.upload(data, "street.jpg")
    assert answer.status_code == 202
    body = answer.json()
    assert body["already_there"] is False
    assert body["filename"] == "street.jpg"
    assert body["file_size"] == len(data)
    assert body["status"] == "queued"
    assert body["status_url"] == f"/api/v1/jobs/{body['job_id']}"
    assert answer.headers["location"] == body["status_url"]
    assert int(answer.headers["retry-after"]) > 0
    assert datetime.fromisoformat(body["upload_time"]).utcoffset() == timedelta(0)

    assert server.finished(body["job_id"])["state"] == "succeeded"
    found = photo(server, body["file_id"])
    assert found["searchable"]
    assert found["sha256"] == hashlib.sha256(data).hexdigest()
    assert server.client.get(body["status_url"]).json()["file_id"] == body["file_id"]


def test_an_upload_that_prefers_to_wait_is_answered_once_it_is_searchable_or_has_failed(
    server: ServerProcess,
) -> None:
    answer = server.client.post(
        UPLOAD, files={"file": ("p.jpg", photo_bytes(2))}, headers={"Prefer": "wait=20"}
    )
    assert answer.status_code == 201
    assert answer.json()["status"] == "succeeded"
    assert answer.headers["preference-applied"] == "wait=20"
    assert "retry-after" not in answer.headers
    assert "searchable" in answer.json()["message"]
    assert photo(server, answer.json()["file_id"])["searchable"]

    broken = {"file": ("broken.jpg", photo_bytes(3)[:-60])}
    failed = server.client.post(UPLOAD, files=broken, headers={"Prefer": "wait=20"}).json()
    assert failed["status"] == "failed"
    assert "can't be decoded" in failed["message"]


def test_the_same_bytes_again_are_the_same_photo_and_elsewhere_they_are_refused(
    server: ServerProcess,
) -> None:
    first = server.indexed(photo_bytes(4), "one.jpg", latitude=45.0, longitude=7.0, place="yard")
    before = stored(server)
    same: list[dict[str, Any]] = [{}, {"latitude": 45.0, "longitude": 7.0, "place": "yard"}]
    for fields in same:
        answer = server.upload(photo_bytes(4), "another-name.jpg", **fields)
        assert answer.status_code == 200
        assert answer.json()["file_id"] == first
        assert answer.json()["already_there"] is True
        assert answer.json()["filename"] == "one.jpg"
        assert answer.json()["status"] == "succeeded"
    elsewhere: list[dict[str, Any]] = [{"latitude": 45.001, "longitude": 7.0}, {"place": "kitchen"}]
    for fields in elsewhere:
        body = problem(server.upload(photo_bytes(4), **fields), 409, "photo_differs")
        assert body["file_id"] == first
        assert f"PATCH /api/v1/uploads/{first}?map=default" in body["detail"]
    found = photo(server, first)
    assert (found["latitude"], found["place"]) == (45.0, "yard")
    assert stored(server) == before


def test_the_same_bytes_again_are_a_202_until_the_photo_is_searchable(
    server: ServerProcess,
) -> None:
    data = photo_bytes(71)
    with server.no_decoding():
        first = server.upload(data)
        queued_again = server.upload(data)
        waited = server.client.post(
            UPLOAD, files={"file": ("p.jpg", data)}, headers={"Prefer": "wait=1"}
        )
        assert waited.headers["preference-applied"] == "wait=1"
        for again in (queued_again, waited):
            assert again.status_code == first.status_code == 202
            assert again.headers["location"] == first.headers["location"]
            assert int(again.headers["retry-after"]) > 0
            assert again.json()["already_there"] is True
            assert again.json()["status"] in ("queued", "running")
        job = f"/api/v1/jobs/{first.json()['job_id']}"
        assert server.client.post(f"{job}/cancel").status_code == 200
        after_cancellation = server.upload(data)
        assert (after_cancellation.status_code, after_cancellation.json()["status"]) == (
            202,
            "queued",
        )
    assert server.finished(first.json()["job_id"])["state"] == "succeeded"
    assert server.upload(data).status_code == 200


def test_exif_fills_what_the_form_leaves_out(server: ServerProcess) -> None:
    found = photo(server, server.indexed(with_gps(7)))
    assert found["latitude"] == pytest.approx(45.5)
    assert found["longitude"] == pytest.approx(-7.25)
    assert found["heading"] == pytest.approx(90)
    taken = datetime.fromisoformat(found["captured_at"])
    assert taken == datetime.fromisoformat("2024-05-01T10:20:30+00:00")
    assert taken.utcoffset() == timedelta(0)

    fields: dict[str, Any] = {"latitude": 1.5, "longitude": 2.5, "heading": 360}
    fields["captured_at"] = "2026-05-01T12:30:00+02:00"
    said = photo(server, server.indexed(with_gps(8), **fields))
    assert (said["latitude"], said["longitude"], said["heading"]) == (1.5, 2.5, 0)
    assert said["captured_at"] == "2026-05-01T10:30:00Z"


# --- what is refused -------------------------------------------------------------------------


JPEG = photo_bytes(50)
BROKEN_HEADER = b"\xff\xd8\xff\xe0" + b"no header at all" * 8


def test_a_bad_upload_is_refused_and_leaves_nothing(server: ServerProcess) -> None:
    before = stored(server)
    problem(server.upload(BROKEN_HEADER), 422, "undecodable_photo")
    nowhere = server.client.post(UPLOAD, files={"file": JPEG}, params={"map": "nowhere"})
    problem(nowhere, 404, "map_not_found")
    field_refused(server.upload(JPEG, latitude="91", longitude="7"), "latitude")
    field_refused(server.upload(JPEG, role="admin"), "role")
    check_nothing_is_left(server, before)


def test_an_undecodable_photo_fails_alone_and_may_be_tried_again(server: ServerProcess) -> None:
    bad = photo_bytes(60)[:-60]
    with server.no_decoding():  # so that they share a batch
        first = server.upload(photo_bytes(61))
        answer = server.upload(bad, "bad.jpg")
        last = server.upload(photo_bytes(62))
    assert answer.status_code == 202
    job = server.finished(answer.json()["job_id"])
    assert job["state"] == "failed"
    assert job["error"]["code"] == "undecodable_photo"
    assert job["error"]["status"] == 422
    assert job["progress"] == {"done": 0, "total": 1, "failed": 1}
    for neighbour in (first, last):
        assert server.finished(neighbour.json()["job_id"])["state"] == "succeeded"
    assert not photo(server, answer.json()["file_id"])["searchable"]

    before = stored(server)
    again = server.upload(bad, "bad.jpg")
    assert again.status_code == 202
    assert again.json()["status"] == "queued"
    assert again.json()["file_id"] == answer.json()["file_id"]
    assert server.finished(again.json()["job_id"])["state"] == "failed"
    assert stored(server) == before
