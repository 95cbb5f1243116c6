"""Places for photos of a map that have none: proposed, given, and taken back."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from PIL import Image

from tests.integration.in_process_api import Service
from tests.support.photos import camera_exif, photo_bytes
from tests.support.problems import problem

NOON = datetime(2026, 5, 1, 12, tzinfo=UTC)


def taken(seconds: float, camera: str = "X100", offset: str | None = "+02:00") -> Image.Exif:
    """The EXIF of a photo so many seconds after noon UTC; the camera's clock is two hours ahead."""
    clock = NOON + timedelta(hours=2, seconds=seconds)
    return camera_exif(clock, offset=offset, model=camera, serial="1")


def stored(service: Service, number: int, exif: Image.Exif | None = None, **fields: Any) -> str:
    """A described photo of the map; its id."""
    data = photo_bytes(number) if exif is None else photo_bytes(number, exif=exif)
    file_id: str = service.upload(data, relative_path=f"trip/{number}.jpg", **fields)["file_id"]
    service.drain()
    return file_id


def propose(service: Service, limit: int = 20, cursor: str = "", **options: Any) -> Any:
    params = {"limit": limit, **({"cursor": cursor} if cursor else {})}
    return service.json("POST", "/places/proposals", params=params, json=options)


def give(service: Service, **place: Any) -> Any:
    return service.json("POST", "/places", json={"photos": [place]})


def test_photos_without_a_place_get_proposals_with_their_reasons(service: Service) -> None:
    stored(service, 1, taken(0), latitude=45.0, longitude=7.0)
    stored(service, 2, latitude=45.1, longitude=7.1, role="query")
    after = stored(service, 3, taken(20, offset=None))
    alone = stored(service, 4)
    stored(service, 5, place="Hall 3")
    test_photo = stored(service, 6, role="query")
    answer = propose(service)
    found = {each["photo"]["image_id"]: each for each in answer["proposals"]}
    assert answer["total"] == 2
    assert found.keys() == {after, alone}
    assert test_photo not in found
    assert found[after]["latitude"] == pytest.approx(45.0, abs=1e-3)
    assert "taken 20 s after trip/1.jpg" in found[after]["reason"]
    assert "taken" not in found[alone]["reason"]
    assert service.json("GET", f"/uploads/{after}")["latitude"] is None


def test_proposals_come_in_pages_and_name_photos_that_are_not_described(service: Service) -> None:
    ids = [stored(service, number) for number in range(3)]
    ids.append(service.upload(photo_bytes(9))["file_id"])
    first = propose(service, limit=2)
    rest = propose(service, limit=2, cursor=first["next_cursor"])
    seen = [each["photo"]["image_id"] for each in first["proposals"] + rest["proposals"]]
    assert seen == ids[::-1]
    assert (first["total"], rest["next_cursor"]) == (4, None)
    assert "not searchable yet" in first["proposals"][0]["error"]
    assert first["proposals"][1]["error"] is None


def test_a_gpx_track_locates_photos_of_a_known_time_zone(service: Service) -> None:
    stored(service, 1, taken(30))
    stored(service, 2, taken(30, camera="Y", offset=None))
    track = [
        {"time": (NOON + timedelta(seconds=s)).isoformat(), "latitude": 45.001, "longitude": 7.0}
        for s in (60, 0)
    ]
    unzoned, zoned = propose(service, track=track)["proposals"]
    assert zoned["latitude"] == pytest.approx(45.001, abs=1e-5)
    assert zoned["reason"].startswith("GPX track")
    assert unzoned["latitude"] is None


def test_a_place_is_given_and_taken_back(service: Service) -> None:
    photo = stored(service, 1)
    answer = give(
        service, file_id=photo, latitude=45.0, longitude=7.0, probability=0.97, reason="looks alike"
    )
    assert answer == {"given": [photo], "skipped": {}}
    shown = service.json("GET", f"/uploads/{photo}")
    assert (shown["latitude"], shown["longitude"]) == (45.0, 7.0)
    given = shown["given_place"]
    assert (given["probability"], given["reason"]) == (0.97, "looks alike")
    assert given.keys() == {"probability", "reason", "given_at", "denied"}
    listed = service.json("GET", "/search", params={"place_given": True})
    assert [each["image_id"] for each in listed["images"]] == [photo]
    assert propose(service)["total"] == 0

    undone = service.json("POST", "/places/undo", json={"file_ids": [photo]})
    assert undone == {"restored": [photo], "changed_since": []}
    shown = service.json("GET", f"/uploads/{photo}")
    assert (shown["latitude"], shown["given_place"]) == (None, None)
    without = service.json("GET", "/search", params={"without_place": True})
    assert [each["image_id"] for each in without["images"]] == [photo]
    again = service.json("POST", "/places/undo", json={"file_ids": [photo]})
    assert again == {"restored": [], "changed_since": []}


def test_a_denied_place_is_kept_and_not_proposed_until_that_is_taken_back(service: Service) -> None:
    stored(service, 1, taken(0), latitude=45.0, longitude=7.0)
    photo = stored(service, 2, taken(20))
    (proposal,) = propose(service)["proposals"]
    denied = {name: proposal[name] for name in ("latitude", "longitude", "radius_m")}
    assert give(service, file_id=photo, **denied, denied=True)["given"] == [photo]
    shown = service.json("GET", f"/uploads/{photo}")
    assert shown["latitude"] is None
    assert shown["given_place"]["denied"] == {**denied, "place": None}
    (left_out,) = propose(service)["proposals"]
    assert left_out["latitude"] is None
    assert left_out["error"].startswith("A person said that it was not taken")
    undone = service.json("POST", "/places/undo", json={"file_ids": [photo]})
    assert undone["restored"] == [photo]
    assert propose(service)["proposals"] == [proposal]


def test_what_has_changed_since_is_left_alone_and_named(service: Service) -> None:
    kept, moved = stored(service, 1), stored(service, 2)
    places = [{"file_id": each, "latitude": 45.0, "longitude": 7.0} for each in (kept, moved)]
    service.json("POST", "/places", json={"photos": places})
    service.json("PATCH", f"/uploads/{moved}", json={"latitude": 46.0})
    assert service.json("GET", f"/uploads/{moved}")["given_place"] is None
    undone = service.json("POST", "/places/undo", json={})
    assert undone == {"restored": [kept], "changed_since": [moved]}
    assert service.json("GET", f"/uploads/{moved}")["latitude"] == 46.0


def test_a_photo_that_has_a_place_keeps_it(service: Service) -> None:
    located = stored(service, 1, latitude=44.0, longitude=8.0)
    labelled = stored(service, 2, place="Hall 3")
    deleted = stored(service, 3)
    service.json("DELETE", f"/uploads/{deleted}")
    ids = [located, labelled, deleted]
    places = [{"file_id": each, "latitude": 45.0, "longitude": 7.0} for each in ids]
    answer = service.json("POST", "/places", json={"photos": places})
    assert answer["given"] == []
    assert answer["skipped"] == {
        located: "has a place meanwhile",
        labelled: "has a place meanwhile",
        deleted: "is not in this map any more",
    }
    assert service.json("GET", f"/uploads/{located}")["latitude"] == 44.0


def test_a_label_and_a_heading_are_given_where_there_is_none(service: Service) -> None:
    bare, turned = stored(service, 1), stored(service, 2, heading=90)
    for photo in (bare, turned):
        give(service, file_id=photo, place=" Hall 3 ", heading=360)
    shown = [service.json("GET", f"/uploads/{photo}") for photo in (bare, turned)]
    assert [(each["place"], each["heading"]) for each in shown] == [("Hall 3", 0), ("Hall 3", 90)]
    service.json("POST", "/places/undo", json={})
    shown = [service.json("GET", f"/uploads/{photo}") for photo in (bare, turned)]
    assert [(each["place"], each["heading"]) for each in shown] == [(None, None), (None, 90)]


def test_an_accepted_proposal_is_no_evidence_for_the_next_one(service: Service) -> None:
    first, second = stored(service, 1, taken(0)), stored(service, 2, taken(20))
    give(service, file_id=first, latitude=45.0, longitude=7.0, probability=0.97)
    (proposal,) = propose(service)["proposals"]
    assert "taken" not in proposal["reason"]
    service.json("POST", "/places/undo", json={})
    give(service, file_id=first, latitude=45.0, longitude=7.0)  # a person said so
    (proposal,) = propose(service)["proposals"]
    assert proposal["photo"]["image_id"] == second
    assert "taken 20 s after trip/1.jpg" in proposal["reason"]


def test_a_clock_that_was_never_set_locates_nothing(service: Service) -> None:
    for number, time in enumerate(("0001-01-01T00:00:00Z", "9999-12-31T23:00:00Z")):
        stored(service, number, captured_at=time)
    assert len(propose(service)["proposals"]) == 2


def test_incomplete_places_are_refused(service: Service) -> None:
    photo = stored(service, 1)
    nowhere = {"latitude": 0, "longitude": 0}
    for place in (
        {},
        {"latitude": 45.0},
        {"place": "  "},
        {"latitude": 95, "longitude": 7},
        nowhere,
    ):
        body = {"photos": [{"file_id": photo, **place}]}
        assert problem(service("POST", "/places", json=body), 422, "invalid_field")
