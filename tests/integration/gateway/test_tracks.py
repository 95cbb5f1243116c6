"""Tracks over HTTP: frames in order, again, late and from two clients, in a map that changes."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from typing import Any
from uuid import UUID

import pytest
from sqlalchemy import func, select, update

from services.gateway.tracks import apply_frames
from services.steward.tasks.delete_maps import purge_deleted_maps
from services.steward.tasks.garbage_collection import collect_queries
from services.steward.tasks.maintenance import delete_old_tracks
from shared.catalog import tracks as tracks_module
from shared.catalog.database.base import db_now_plus
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation
from shared.catalog.jobs import Job
from shared.catalog.tracks import Track, TrackFrame
from shared.evaluation.places.levels import FEATURES
from shared.evaluation.places.probability import PlaceModel
from shared.search_api.protocol import SearchRequest, SearchResponse
from shared.storage.keys import query_key, query_vector_key
from tests.integration.in_process_api import Service
from tests.support.photos import photo_bytes
from tests.support.problems import problem

BEGIN = datetime(2026, 5, 1, 12, tzinfo=UTC)
STREET = range(5)
METRES_APART = 80.0
DEGREES_PER_METRE = 1 / 111_195


def time_of(number: float) -> str:
    return (BEGIN + timedelta(seconds=10 * number)).isoformat()


def latitude_of(number: int) -> float:
    return 45 + number * METRES_APART * DEGREES_PER_METRE


@pytest.fixture
def street(service: Service) -> Service:
    """A map of a street, one photo every 80 metres to the north."""
    for number in STREET:
        service.upload(
            photo_bytes(number), latitude=latitude_of(number), longitude=7.0, heading=10 * number
        )
    service.drain()
    return service


def begin(service: Service, **params: Any) -> str:
    body = {"max_speed_mps": 9, **params}  # the frames are 80 m and 10 s apart
    return str(service.json("POST", "/tracks", 201, json=body)["track_id"])


def send(service: Service, track_id: str, number: int, status: int = 202, **fields: Any) -> Any:
    """Send a frame at the street's photo of that number."""
    headers = fields.pop("headers", {})
    data = {"captured_at": time_of(number), **fields}
    files = {"file": (f"frame-{number}.jpg", photo_bytes(number))}
    path = f"/tracks/{track_id}/frames"
    return service.json("POST", path, status, data=data, files=files, headers=headers)


def refused(service: Service, track_id: str, code: str, number: int, **fields: Any) -> Any:
    data = {"captured_at": time_of(number), **fields}
    files = {"file": ("frame.jpg", photo_bytes(number))}
    answer = service("POST", f"/tracks/{track_id}/frames", data=data, files=files)
    return problem(answer, answer.status_code, code)


def read(service: Service, track_id: str, **params: Any) -> Any:
    return service.json("GET", f"/tracks/{track_id}", params=params)


def ride(service: Service, track_id: str, *numbers: int) -> Any:
    for number in numbers:
        send(service, track_id, number)
    service.drain()
    return read_applied(service, track_id)


def read_applied(service: Service, track_id: str) -> Any:
    """Read the track until no frame is pending: one read applies frames for a limited time."""
    while (track := read(service, track_id))["pending"]:
        pass
    return track


def test_a_ride_is_followed_frame_by_frame(street: Service, catalog: Catalog) -> None:
    track_id = begin(street)
    empty = read(street, track_id)
    assert (empty["version"], empty["pending"], empty["state"], empty["frames"]) == (0, 0, None, [])
    first = send(street, track_id, 0)
    assert (first["status"], first["state"], first["version"]) == ("pending", None, 1)
    assert read(street, track_id)["pending"] == 1
    for number in (1, 2, 3):  # a single one of five photos does not stand out enough
        odometry: dict[str, Any] = {
            "distance_m": METRES_APART,
            "distance_accuracy_m": 2,
            "turn_degrees": 10,
        }
        send(street, track_id, number, **odometry, turn_accuracy_degrees=2)
    street.drain()
    track = read(street, track_id)
    assert (track["version"], track["pending"], track["smoothed"]) == (4, 0, False)
    assert [frame["status"] for frame in track["frames"]] == ["applied"] * 4
    state = track["state"]
    assert state == track["frames"][-1]["state"]
    assert state["status"] == "tracking"
    assert state["latitude"] == pytest.approx(latitude_of(3), abs=1e-5)
    assert (state["longitude"], state["heading"]) == (pytest.approx(7.0), 30.0)
    assert [level["radius_m"] for level in state["levels"]] == [25, 100, 500, 2000]
    probabilities = [level["probability"] for level in state["levels"]]
    assert probabilities == sorted(probabilities)
    assert state["probability"] == probabilities[0] > 0.8
    smoothed = read(street, track_id, smoothed=True)
    assert smoothed["smoothed"] is True
    known_later = [frame["state"]["probability"] for frame in smoothed["frames"]]
    assert known_later[0] > track["frames"][0]["state"]["probability"]
    assert smoothed["frames"][-1]["state"]["latitude"] == pytest.approx(state["latitude"])
    frame = street.json("GET", track["frames"][1]["frame_url"].removeprefix("/api/v1"))
    assert frame == track["frames"][1]
    other = begin(street, motion="walk", max_speed_mps=None)
    listed = street.json("GET", "/tracks", params={"limit": 1})
    assert [item["track_id"] for item in listed["tracks"]] == [other]
    rest = street.json("GET", "/tracks", params={"cursor": listed["next_cursor"]})
    assert [(item["track_id"], item["state"]) for item in rest["tracks"]] == [(track_id, state)]
    assert street.json("DELETE", f"/tracks/{track_id}")["deleted_track_id"] == track_id
    problem(street("GET", f"/tracks/{track_id}"), 404, "track_not_found")
    assert count(catalog, TrackFrame) == 0


def count(catalog: Catalog, table: Any) -> int:
    with catalog.read() as session:
        return session.scalar(select(func.count()).select_from(table)) or 0


def test_one_track_of_a_caller_is_smoothed_at_a_time(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    track_id = begin(service)
    smoothing, refused = threading.Event(), threading.Event()

    def smooth(*_: Any) -> dict[UUID, Any]:
        smoothing.set()
        assert refused.wait(60)
        return {}

    monkeypatch.setattr("services.gateway.routes.tracks.smooth_states", smooth)
    with ThreadPoolExecutor(1) as pool:
        first = pool.submit(read, service, track_id, smoothed=True)
        assert smoothing.wait(60)
        answer = service("GET", f"/tracks/{track_id}", params={"smoothed": True})
        plain = read(service, track_id)
        refused.set()
        assert first.result()["smoothed"] is True
    problem(answer, 429, "too_many_smoothed_tracks")
    assert int(answer.headers["retry-after"]) > 0
    assert plain["smoothed"] is False
    assert read(service, track_id, smoothed=True)["smoothed"] is True


def test_a_frame_that_is_sent_twice_is_one_frame(street: Service) -> None:
    track_id = begin(street)
    first = send(street, track_id, 0)
    assert send(street, track_id, 0)["frame_id"] == first["frame_id"]
    ride(street, track_id, 1)
    again = send(street, track_id, 0, 200, expected_version=7)
    assert (again["frame_id"], again["status"], again["version"]) == (
        first["frame_id"],
        "applied",
        1,
    )
    keyed = [send(street, track_id, 2, headers={"Idempotency-Key": "frame-2"}) for _ in "ab"]
    assert keyed[0] == keyed[1]
    assert read(street, track_id)["version"] == 3
    differs = refused(street, track_id, "frame_differs", 3, captured_at=time_of(0))
    assert (differs["status"], differs["frame_id"]) == (409, first["frame_id"])
    originals = {first["job_id"], *(f["job_id"] for f in read(street, track_id)["frames"])}
    stored = {info.key for info in street.store.list("queries/") if "." not in info.key}
    assert stored <= {query_key(UUID(job_id)) for job_id in originals}, "repeated photos are gone"


def test_a_late_frame_changes_the_states_after_it(
    street: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    in_order, late = begin(street), begin(street)
    expected = ride(street, in_order, 0, 1, 2, 3)
    before = ride(street, late, 1, 2, 3)
    assert before["state"] != expected["state"]
    after = ride(street, late, 0)
    assert [frame["version"] for frame in after["frames"]] == [4, 1, 2, 3]
    for frame, other in zip(after["frames"], expected["frames"], strict=True):
        # The later frames were searched without the late one as their background.
        assert frame["state"]["image_id"] == other["state"]["image_id"]
        assert frame["state"]["probability"] == pytest.approx(
            other["state"]["probability"], abs=0.2
        )
    assert after["state"]["probability"] != before["state"]["probability"]
    monkeypatch.setattr(tracks_module, "MAX_LATE_FRAMES", 2)
    refusal = refused(street, late, "frame_too_late", 4, captured_at=time_of(0.5))
    assert refusal["status"] == 409
    send(street, late, 4, captured_at=time_of(1.5))
    street.drain()
    assert read(street, late)["pending"] == 0
    with street.catalog.read() as session:
        stored = session.scalars(
            select(TrackFrame.captured_at)
            .where(TrackFrame.track_id == UUID(late), TrackFrame.belief.is_not(None))
            .order_by(TrackFrame.captured_at)
        ).all()
    assert [time.isoformat() for time in stored] == [time_of(1.5), time_of(2), time_of(3)]


def test_a_frame_is_searched_without_what_the_earlier_frames_share(
    street: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    search, requests = street.search.search, []

    def record(request: SearchRequest) -> SearchResponse:
        requests.append(request)
        return search(request)

    monkeypatch.setattr(street.search, "search", record)
    track = ride(street, begin(street), 0, 1, 2)
    rows = [query_vector_key(UUID(frame["job_id"])) for frame in track["frames"]]
    backgrounds = [[row.object_key for row in request.background] for request in requests]
    assert backgrounds == [[], rows[:1], rows[:2]]


def test_two_clients_on_one_track_get_an_error(street: Service) -> None:
    track_id = begin(street)
    mine = send(street, track_id, 0, expected_version=0)
    send(street, track_id, 1, expected_version=mine["version"])
    conflict = refused(street, track_id, "track_changed", 2, expected_version=mine["version"])
    assert (conflict["status"], conflict["version"]) == (409, 2)
    assert read(street, track_id)["version"] == 2
    send(street, track_id, 2, expected_version=conflict["version"])


def test_two_gateways_apply_a_frame_once(street: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    track_id = begin(street)
    send(street, track_id, 0)
    street.drain()
    search = apply_frames._search_evidence
    entered: list[None] = []

    def search_while_another_applies(*args: Any) -> Any:
        evidence = search(*args)
        if not entered:
            entered.append(None)
            assert read(street, track_id)["pending"] == 0
        return evidence

    monkeypatch.setattr(apply_frames, "_search_evidence", search_while_another_applies)
    assert read(street, track_id)["pending"] == 0
    with street.catalog.read() as session:
        track = session.get_one(Track, UUID(track_id))
    assert (track.version, track.revision) == (1, 1)


def test_frames_are_applied_in_order_and_a_failed_one_is_left_out(street: Service) -> None:
    track_id = begin(street)
    first = send(street, track_id, 0)
    cancelled = send(street, track_id, 1)
    street.json("POST", f"/jobs/{cancelled['job_id']}/cancel")
    assert [f["status"] for f in read(street, track_id)["frames"]] == ["pending", "pending"], (
        "the first is not described yet"
    )
    track = ride(street, track_id, 2)
    assert [f["status"] for f in track["frames"]] == ["applied", "failed", "applied"]
    assert track["frames"][1]["error"]["code"] == "job_cancelled"
    assert track["state"] == track["frames"][2]["state"]
    assert (track["version"], track["pending"]) == (3, 0)
    result = street.json("GET", f"/jobs/{first['job_id']}/result")
    assert result["similar_images"][0]["latitude"] == 45


def test_the_map_may_change_between_two_frames(street: Service) -> None:
    track_id = begin(street)
    track = ride(street, track_id, 0, 1)
    street.json("DELETE", f"/uploads/{track['state']['image_id']}")
    # As if the generation of the descriptor had been replaced and deleted.
    lost = send(street, track_id, 2)
    street.drain()
    street.store.delete(query_vector_key(UUID(lost["job_id"])))
    assert read(street, track_id)["pending"] == 1, "the photo is described again"
    street.drain()
    track = read(street, track_id)
    assert track["pending"] == 0
    assert track["state"]["latitude"] == pytest.approx(latitude_of(2), abs=1e-4)
    for number in (2, 3):
        street.json("DELETE", f"/uploads/{nearest(street, number)}")
    assert read(street, track_id, smoothed=True)["state"] == track["state"]
    track = ride(street, track_id, 3)
    assert track["pending"] == 0
    assert track["state"]["latitude"] != pytest.approx(latitude_of(3), abs=1e-5)


def nearest(service: Service, number: int) -> str:
    near = f"{latitude_of(number)},7,1"
    return str(service.json("GET", "/search", params={"near": near})["images"][0]["image_id"])


def test_measured_positions_help(street: Service) -> None:
    alone, placed, without_fix = begin(street), begin(street), begin(street)
    fix: dict[str, Any] = {"latitude": latitude_of(0), "longitude": 7, "accuracy_m": 10}
    send(street, placed, 0, **fix)
    odometry: dict[str, Any] = {"distance_m": 80, "distance_accuracy_m": 5, "turn_degrees": 10}
    send(street, placed, 1, **odometry)
    ride(street, alone, 0, 1)
    send(street, without_fix, 0, latitude=0, longitude=0, accuracy_m=10)
    ride(street, without_fix, 1)
    first, measured, unmeasured = (
        [frame["state"]["probability"] for frame in read(street, track)["frames"]]
        for track in (alone, placed, without_fix)
    )
    assert measured[0] > first[0]
    assert unmeasured == first, "0, 0 is no fix"
    smoothed = read(street, placed, smoothed=True)["frames"]
    assert smoothed[0]["state"]["probability"] >= measured[0] - 1e-9


def test_a_track_of_places_follows_their_labels(service: Service) -> None:
    for number in STREET:
        time = (BEGIN - timedelta(days=9) + timedelta(seconds=number)).isoformat()
        service.upload(photo_bytes(number), place=f"room {number}", captured_at=time)
    service.drain()
    track_id = begin(service)
    track = ride(service, track_id, 0, 1, 2)
    assert [f["state"]["place"] for f in track["frames"]] == ["room 0", "room 1", "room 2"]
    assert [level["place"] for level in track["state"]["levels"]] == ["room 2"]
    assert track["state"]["latitude"] is None


def test_a_map_whose_place_model_finds_that_it_lacks_each_frame_is_not_tracked(
    service: Service, catalog: Catalog
) -> None:
    for number in STREET:
        service.upload(photo_bytes(number), place=f"room {number}")
    service.drain()
    outside = {}
    for log_odds in (-3.0, 3.0):
        model = PlaceModel(source="own_photos", missing_place=(log_odds, *[0.0] * len(FEATURES)))
        with catalog.write() as session:
            session.execute(update(Generation).values(calibration=model.model_dump(mode="json")))
        track_id = begin(service)
        track = ride(service, track_id, 0, 1, 2)
        outside[log_odds] = track["state"]["not_in_map_probability"]
        smoothed = read(service, track_id, smoothed=True)["state"]
        assert smoothed["not_in_map_probability"] == pytest.approx(outside[log_odds])
    assert track["state"]["status"] == "lost"
    assert outside[-3.0] < 0.05 < 0.95 < outside[3.0]


def test_rows_and_objects_of_a_track_are_deleted_with_it(street: Service, catalog: Catalog) -> None:
    pending, done = begin(street), begin(street)
    job_id = send(street, pending, 0)["job_id"]
    street.drain()
    ride(street, done, 1)
    collect_queries(catalog, street.store, -1)
    assert street.store.head(query_key(UUID(job_id))), "the photo of a pending frame stays"
    with catalog.read() as session:
        assert [
            str(job) for job in session.scalars(select(Job.id).where(Job.kind == "describe"))
        ] == [job_id]
    assert read(street, pending)["frames"][0]["status"] == "applied"
    with catalog.write() as session:
        session.execute(
            update(Track).where(Track.id == UUID(done)).values(updated_at=db_now_plus(-31 * 86_400))
        )
    delete_old_tracks(catalog)
    assert [item["track_id"] for item in street.json("GET", "/tracks")["tracks"]] == [pending]
    street.json("DELETE", "/maps/default")
    purge_deleted_maps(catalog, street.store)
    assert (count(catalog, Track), count(catalog, TrackFrame)) == (0, 0)


BAD_FIELDS: list[dict[str, Any]] = [
    {"captured_at": "yesterday"},
    {"captured_at": ""},
    {"latitude": 45, "longitude": 7},
    {"latitude": 95, "longitude": 7, "accuracy_m": 5},
    {"latitude": "nan", "longitude": 7, "accuracy_m": 5},
    {"distance_m": 5},
    {"distance_m": -1, "distance_accuracy_m": 1},
    {"turn_degrees": 5},
    {"expected_version": -1},
    {"speed": 5},
]


def test_invalid_fields_are_refused_by_name_and_leave_nothing(service: Service) -> None:
    track_id = begin(service)
    for fields in BAD_FIELDS:
        refusal = refused(service, track_id, "invalid_field", 0, **fields)
        assert refusal["status"] == 422, fields
        assert refusal["errors"][0]["field"] in {*fields, "form"}
    for body in (
        {"motion": "walk", "max_speed_mps": 3},
        {"motion": "swim"},
        {"latitude": 45, "longitude": 7},
        {"max_speed_mps": 0},
    ):
        refusal = problem(service("POST", "/tracks", json=body), 422, "invalid_field")
        assert "Value error" not in refusal["detail"]
    assert read(service, track_id)["version"] == 0
    assert list(service.store.list("queries/")) == []
    for method, path in (
        ("GET", "/tracks/no-id"),
        ("POST", f"/tracks/{UUID(int=0)}/frames"),
        ("DELETE", f"/tracks/{UUID(int=0)}"),
    ):
        problem(service(method, path), 404, "track_not_found")
    path = f"/tracks/{track_id}/frames/{UUID(int=0)}"
    problem(service("GET", path), 404, "frame_not_found")


def test_frames_of_any_times_and_with_any_odometry_lead_to_a_state(street: Service) -> None:
    track_id = begin(street)
    jump: dict[str, Any] = {"distance_m": 1e6, "distance_accuracy_m": 5e-324, "turn_degrees": -360}
    pole: dict[str, Any] = {"latitude": -90, "longitude": 180, "accuracy_m": 1e5}
    times = ("0001-01-01T00:00:00Z", time_of(0), "9999-12-31T23:59:59.999999Z")
    for time, fields in zip(times, ({}, jump, pole), strict=True):
        send(street, track_id, 0, captured_at=time, **fields)
    street.drain()
    for smoothed in (False, True):
        frames = read(street, track_id, smoothed=smoothed)["frames"]
        assert [frame["status"] for frame in frames] == ["applied"] * 3
        for state in (frame["state"] for frame in frames):
            assert 0 <= state["probability"] <= 1
            assert 0 <= state["not_in_map_probability"] <= 1


def test_a_full_track_takes_no_more(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tracks_module, "MAX_TRACK_FRAMES", 1)
    track_id = begin(service)
    send(service, track_id, 0)
    assert refused(service, track_id, "track_full", 1)["status"] == 409
    monkeypatch.setattr("services.gateway.routes.tracks.MAX_SMOOTHED_FRAMES", 0)
    answer = service("GET", f"/tracks/{track_id}", params={"smoothed": True})
    problem(answer, 409, "track_too_long")
