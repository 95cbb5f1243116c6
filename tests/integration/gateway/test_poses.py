"""Poses over HTTP: coordinates with radii, why there is none, and OGC GeoPose."""

from __future__ import annotations

import base64
import contextlib
import hashlib
import math
from dataclasses import replace
from io import BytesIO
from typing import Any
from uuid import UUID

import numpy as np
import pytest
from PIL import Image
from PIL.ExifTags import IFD, Base

from services.gateway.routes import similarity
from services.gateway.similarity import pose as similarity_pose
from services.gateway.similarity.geopose import geopose
from shared.catalog.chunks import Chunk
from shared.catalog.generations import Generation
from shared.catalog.maps import Map, Matching
from shared.catalog.photos import Photo
from shared.catalog.reconstructions import ReconstructedComponent
from shared.catalog.tracks import TrackFrame
from shared.errors import NotFound, Unavailable, Unprocessable
from shared.evaluation.places.probability import Background, Elsewhere, PlaceModel, shipped_prior
from shared.geodesy import distance_m
from shared.jobs import Job
from shared.matching.features import FULL_SIDE, LocalFeatures
from shared.responses.similarity import CameraPoseResponse
from shared.search_api.protocol import PoseRequest, PoseResponse
from shared.storage.keys import query_features_key
from tests.integration.in_process_api import Service
from tests.support.catalog_rows import add_reconstruction
from tests.support.local_features import MODEL, add_features, put_features, scene_features
from tests.support.photos import encoded, photo_bytes
from tests.support.poses import (
    ALIGNMENT,
    CALIBRATION,
    CENTRE,
    HEADING,
    ORIGIN,
    SIMILARITY,
    TURN_DEGREES,
    take_query,
)
from tests.support.problems import problem
from tests.support.reconstructed_scene import CAMERA, ReconstructedScene

NOT_ALIGNED = "2 of its photos have coordinates, and 3 are needed."


@pytest.fixture
def scene() -> ReconstructedScene:
    return ReconstructedScene()


@pytest.fixture
def ids(service: Service, scene: ReconstructedScene) -> list[str]:
    """The photos of the scene, and one of another place; they have no reconstruction yet."""
    ids = service.indexed(*range(scene.photos + 1))
    features = [*scene.features.values(), scene_features(1)]
    photos = dict(zip(map(UUID, ids), features, strict=True))
    add_features(service.catalog, service.store, photos)
    return ids


def reconstruct(
    service: Service, scene: ReconstructedScene, ids: list[str], **columns: Any
) -> None:
    """The scene as reconstruction of the first photos; `columns` are of its component."""
    photo_ids = tuple(map(UUID, ids[: scene.photos]))
    data = replace(scene.component, photo_ids=photo_ids).encode()
    key = "reconstructions/1/0.npz"
    service.store.put(key, data)
    values = {"alignment": ALIGNMENT, "calibration": CALIBRATION, **columns}
    component = ReconstructedComponent(
        number=0,
        object_key=key,
        sha256={key: hashlib.sha256(data).hexdigest()},
        photos=scene.photos,
        points=scene.points,
        mean_reprojection_error_pixels=0.5,
        **values,
    )
    with service.catalog.write() as session:
        add_reconstruction(
            session,
            service.store,
            session.query(Generation).one(),
            features_model=MODEL,
            components=[component.model_dump(mode="json")],
        )


def described(
    service: Service, features: LocalFeatures, photo: bytes | None = None, **params: Any
) -> str:
    """The job of a described new photo that has these local features."""
    job_id = service.ask(photo or photo_bytes(0), **params)
    service.drain()
    key = query_features_key(UUID(job_id))
    service.store.delete(key)
    put_features(service.store, features, key=key)
    return job_id


def ask(service: Service, features: LocalFeatures, **params: Any) -> dict[str, Any]:
    job_id = described(service, features, **({"pose": "true"} | params))
    answer: dict[str, Any] = service.json("GET", f"/jobs/{job_id}/result")
    return answer


def test_pose_has_coordinates_radii_the_camera_and_the_points_that_were_seen(
    service: Service, scene: ReconstructedScene, ids: list[str]
) -> None:
    reconstruct(service, scene, ids)
    answer = ask(service, take_query(scene), focal_length=CAMERA.focal_length)
    assert answer["no_pose"] is None
    pose = answer["pose"]
    place = ORIGIN.to_geographic(SIMILARITY.apply(CENTRE))
    away = distance_m(place.latitude, place.longitude, pose["latitude"], pose["longitude"])
    assert away < 0.15
    assert pose["altitude_m"] == pytest.approx(place.altitude_m, abs=0.1)
    assert pose["heading"] == pytest.approx((HEADING - TURN_DEGREES) % 360, abs=0.3)
    assert 0 < pose["radius_68_m"] < pose["radius_95_m"] < 0.5
    assert 0 < pose["heading_68_degrees"] < pose["heading_95_degrees"] < 2
    w, *_, z = pose["enu_quaternion"]
    assert 2 * math.degrees(math.atan2(z, w)) == pytest.approx(90 - pose["heading"] + 360, abs=0.5)
    assert (pose["component"], pose["reason"]) == (0, None)
    assert np.linalg.norm(np.array(pose["position"]) - CENTRE) < 0.05
    assert pose["camera"]["source"] == "given"
    assert (pose["camera"]["width"], pose["camera"]["height"]) == (CAMERA.width, CAMERA.height)
    assert 50 < len(pose["seen"]) <= pose["inliers"] <= pose["matches"]
    without = ask(service, take_query(scene), pose="false")
    assert (without["pose"], without["no_pose"]) == (None, None)


def test_focal_length_is_that_of_the_exif_of_a_query_and_of_the_model_for_its_own_photos(
    service: Service, scene: ReconstructedScene, ids: list[str]
) -> None:
    reconstruct(service, scene, ids)
    exif = Image.Exif()
    exif.get_ifd(IFD.Exif)[Base.FocalLengthIn35mmFilm] = round(36 * CAMERA.focal_length)
    photo = Image.open(BytesIO(photo_bytes(0)))
    job_id = described(service, take_query(scene), encoded(photo, "JPEG", exif=exif), pose="true")
    pose = service.json("GET", f"/jobs/{job_id}/result")["pose"]
    assert pose["camera"]["source"] == "exif"
    assert pose["camera"]["focal_pixels"] == pytest.approx(CAMERA.focal_pixels, rel=0.02)
    path = f"/similarity/{ids[2]}"
    stored = service.json("POST", path, params={"pose": "true"})["pose"]
    assert stored["camera"]["source"] == "map"
    assert np.linalg.norm(stored["position"] - scene.component.centres()[2]) < 0.05
    with service.catalog.write() as session:
        session.get_one(Photo, UUID(ids[2])).focal_length = 2 * CAMERA.focal_length
    stored = service.json("POST", path, params={"pose": "true"})["pose"]
    assert stored["camera"]["source"] == "map"
    assert stored["camera"]["focal_pixels"] == pytest.approx(CAMERA.focal_pixels, rel=0.05)


@pytest.mark.parametrize(
    ("columns", "reason"),
    [
        ({"alignment": None, "not_aligned": NOT_ALIGNED}, NOT_ALIGNED),
        ({"calibration": None}, "could not be measured"),
    ],
    ids=["not aligned", "not calibrated"],
)
def test_component_without_coordinates_gives_a_pose_in_its_frame_and_the_reason(
    service: Service,
    scene: ReconstructedScene,
    ids: list[str],
    columns: dict[str, Any],
    reason: str,
) -> None:
    reconstruct(service, scene, ids, **columns)
    pose = ask(service, take_query(scene))["pose"]
    assert reason in pose["reason"]
    assert {pose[name] for name in ("latitude", "longitude", "radius_68_m", "heading")} == {None}
    assert np.linalg.norm(np.array(pose["position"]) - CENTRE) < 0.2
    with pytest.raises(Unprocessable, match=reason):
        geopose(CameraPoseResponse(**pose))


def look_elsewhere(service: Service, place: dict[Any, Any]) -> None:
    """Make every query look as if the map, whose photos are at this place, lacked its place."""
    others = (0.0,) * (len(shipped_prior().level) - 1)
    model = PlaceModel(
        source="own_photos",
        own_photos=20,
        levels=((-5, *others),),
        elsewhere=Elsewhere(
            coefficients=(9.0, 0.0, 0.0),
            matched=(9.0, 0.0, 0.0, 0.0),
            background=Background(mean=0.0, deviation=1.0),
        ),
    )
    with service.catalog.write() as session:
        session.query(Photo).update(place)
        session.query(Generation).one().calibration = model.model_dump(mode="json")


@pytest.mark.parametrize("needed", [1, 1000])
def test_enough_points_outweigh_that_coordinates_look_elsewhere(
    service: Service,
    scene: ReconstructedScene,
    ids: list[str],
    monkeypatch: pytest.MonkeyPatch,
    needed: int,
) -> None:
    monkeypatch.setattr(similarity_pose, "POINTS_TO_DOUBLE_ODDS", needed)
    reconstruct(service, scene, ids)
    look_elsewhere(service, {"latitude": 45.0, "longitude": 7.7})
    answer = ask(service, take_query(scene))
    assert (answer["pose"] is None) == (needed == 1000)
    assert answer["no_pose"] is None or "would be needed" in answer["no_pose"]


@pytest.mark.parametrize(
    ("case", "reason"),
    [
        ("no reconstruction", "no reconstruction yet"),
        ("features of another model", "is of local features of xfeat@0123456789ab"),
        ("matching off", "`matching` is off"),
        ("search fails", "No search worker answers."),
        ("floor that the map lacks", "probably not in this map"),
    ],
)
def test_query_without_a_pose_is_answered_with_the_reason(
    service: Service,
    scene: ReconstructedScene,
    ids: list[str],
    monkeypatch: pytest.MonkeyPatch,
    case: str,
    reason: str,
) -> None:
    if case != "no reconstruction":
        reconstruct(service, scene, ids)
    if case == "features of another model":
        with service.catalog.write() as session:
            session.query(Chunk).update({"features_model": "other@0123456789ab"})
    elif case == "matching off":
        with service.catalog.write() as session:
            session.query(Map).one().matching = Matching.OFF
    elif case == "search fails":

        def fail(_: object) -> None:
            raise Unavailable("search_unavailable", "No search worker answers.")

        monkeypatch.setattr(service.search, "estimate_pose", fail)
    elif case == "floor that the map lacks":
        look_elsewhere(service, {"place": "hall"})
    answer = ask(service, take_query(scene))
    assert answer["pose"] is None
    assert reason in answer["no_pose"]
    assert len(answer["similar_images"]) == len(ids)


def test_a_query_with_a_pose_gets_local_features_where_there_is_a_reconstruction(
    service: Service, scene: ReconstructedScene, ids: list[str]
) -> None:
    for with_pose, is_reconstructed in ((True, False), (False, True), (True, True)):
        if is_reconstructed:
            reconstruct(service, scene, ids)
        started = service.json(
            "POST",
            "/similarity",
            202,
            files={"file": ("query.jpg", photo_bytes(0))},
            params={"pose": with_pose},
        )
        service.drain()
        has_features = with_pose and is_reconstructed
        with contextlib.nullcontext() if has_features else pytest.raises(NotFound):
            service.store.get(query_features_key(UUID(started["job_id"])))


PRINCIPAL_POINT = np.array([332.0, 231.0])


@pytest.fixture
def describe_queries(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    """Describes queries while the gateway waits: as the scene seen beside the middle."""
    features = take_query(ReconstructedScene())
    moved = features.pixels() + PRINCIPAL_POINT - (CAMERA.width / 2, CAMERA.height / 2)
    inside = ((moved > 0) & (moved < (CAMERA.width, CAMERA.height))).all(axis=1)
    features = LocalFeatures(
        CAMERA.width,
        CAMERA.height,
        (moved[inside] / (CAMERA.width, CAMERA.height) * FULL_SIDE).round().astype(np.uint16),
        features.descriptors[inside],
    )

    async def describe(_gateway: object, job_id: UUID, _seconds: float) -> Job:
        service.drain()
        key = query_features_key(job_id)
        service.store.delete(key)
        put_features(service.store, features, key=key)
        with service.catalog.read() as session:
            return session.get_one(Job, job_id)

    monkeypatch.setattr(similarity, "wait_for_job", describe)


def geopose_request(version: int, **changes: Any) -> dict[str, Any]:
    """A request as clients of the Open AR Cloud send it, with changes of its camera reading."""
    focal, (x, y) = CAMERA.focal_pixels, PRINCIPAL_POINT.tolist()
    params = {"model": "PINHOLE", "modelParams": [focal, focal, x, y]}
    image = {
        "sequenceNumber": 0,
        "imageFormat": "JPG",
        "size": [CAMERA.width, CAMERA.height],
        "imageBytes": base64.b64encode(photo_bytes(0)).decode(),
        "imageOrientation": {"mirrored": False, "rotation": 0},
    }
    place = {"latitude": -33.9, "longitude": 18.4, "altitude": 0, "accuracy": 0, "heading": 0}
    sent = {"timestamp": 1795822545000, "privacy": {"dataRetention": []}}
    cameras, positions = {**sent, "sensorId": "eye"}, {**sent, "sensorId": "gps"}
    sensors: list[dict[str, Any]] = [
        {"id": "eye", "type": "camera"},
        {"id": "gps", "type": "geolocation"},
    ]
    readings: Any
    if version == 1:
        sensors[0]["params"] = changes.pop("params", params)
        readings = [{**cameras, "reading": image | changes}, {**positions, "reading": place}]
    else:
        readings = {
            "cameraReadings": [{**cameras, **image, "params": params, **changes}],
            "geolocationReadings": [{**positions, **place}],
            "wiFiReadings": [],
        }
    return {
        "id": "a request",
        "timestamp": 1795822545000,
        "type": "geopose",
        "sensors": sensors,
        "sensorReadings": readings,
        "priorPoses": [],
    }


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.usefixtures("describe_queries")
def test_request_of_the_geopose_protocol_is_answered_with_the_pose_of_its_camera(
    service: Service, scene: ReconstructedScene, ids: list[str], version: int
) -> None:
    """Its coarse position is on another continent: a hint is no filter."""
    reconstruct(service, scene, ids)
    answer = service.json("POST", "/geopose", json=geopose_request(version))
    assert answer["id"] == "a request"
    assert (answer["timestamp"], answer["type"]) == (1795822545000, "geopose")
    place = ORIGIN.to_geographic(SIMILARITY.apply(CENTRE))
    found = answer["geopose"]
    assert found["position"] == pytest.approx(
        {"lat": place.latitude, "lon": place.longitude, "h": place.altitude_m}, abs=0.1
    )
    away = distance_m(place.latitude, place.longitude, *list(found["position"].values())[:2])
    assert away < 0.15
    yaw = 2 * math.degrees(math.atan2(found["quaternion"]["z"], found["quaternion"]["w"]))
    assert yaw == pytest.approx(90 - HEADING + TURN_DEGREES, abs=0.3)
    assert 0 < answer["accuracy"]["position"] < 0.5
    assert 0 < answer["accuracy"]["orientation"] < 2


@pytest.mark.parametrize(
    ("changes", "status", "code", "detail"),
    [
        ({"params": {"model": "PINHOLE", "modelParams": [500]}}, 422, "invalid_field", "4 param"),
        ({"params": {"model": "FISHEYE", "modelParams": []}}, 422, "invalid_field", "none of"),
        ({"params": {"model": "PINHOLE", "modelParams": [9, 0, 5, 5]}}, 422, "invalid_field", "fy"),
        ({"size": [480, 640]}, 422, "invalid_field", "480 x 640, but the photo has"),
        ({"imageOrientation": {"mirrored": True}}, 422, "invalid_field", "not upright"),
        ({"imageOrientation": {"rotation": 90}}, 422, "invalid_field", "not upright"),
        ({"imageBytes": "data:image/jpeg;base64,%"}, 422, "invalid_field", "not base64"),
        ({"imageBytes": "ä"}, 422, "invalid_field", "not base64"),
        ({"imageBytes": "AAAA"}, 415, "unsupported_photo", "not a photo"),
    ],
)
@pytest.mark.parametrize("version", [1, 2])
def test_invalid_request_of_the_geopose_protocol_is_refused_with_the_field(
    service: Service, version: int, changes: dict[str, Any], status: int, code: str, detail: str
) -> None:
    service.indexed(0)
    answer = service("POST", "/geopose", json=geopose_request(version, **changes))
    assert detail in problem(answer, status, code)["detail"]


def test_request_of_the_geopose_protocol_needs_a_photo_and_an_end(
    service: Service, ids: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    empty: list[Any] = [[], [None, {"sensorId": [], "reading": {}}], {"cameraReadings": []}]
    for readings in empty:
        sent = geopose_request(1) | {"sensors": [None], "sensorReadings": readings}
        answer = service("POST", "/geopose", json=sent)
        assert "cameraReadings" in problem(answer, 422, "invalid_field")["detail"]
    monkeypatch.setattr(similarity, "GEOPOSE_WAIT_SECONDS", 0.01)
    answer = service("POST", "/geopose", json=geopose_request(2))
    problem(answer, 503, "query_unfinished")


@pytest.mark.usefixtures("describe_queries")
def test_photos_at_the_hint_are_the_first_candidates_of_a_pose(
    service: Service, scene: ReconstructedScene, ids: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    reconstruct(service, scene, ids)
    requests: list[PoseRequest] = []
    estimate = service.search.estimate_pose

    def record(request: PoseRequest) -> PoseResponse:
        requests.append(request)
        return estimate(request)

    monkeypatch.setattr(service.search, "estimate_pose", record)
    for file_id in ids:
        fields = {"latitude": -33.9001, "longitude": 18.4} if file_id == ids[4] else {}
        fields = fields or {"latitude": 45.0, "longitude": 7.7}
        service.json("PATCH", f"/uploads/{file_id}", json=fields)
    service.drain()
    service.json("POST", "/geopose", json=geopose_request(2))
    candidates = [str(candidate.photo_id) for candidate in requests[0].candidates]
    assert candidates[0] == ids[4]
    assert set(candidates) == set(ids)


@pytest.mark.usefixtures("describe_queries")
def test_pose_without_a_height_is_no_geopose(
    service: Service, scene: ReconstructedScene, ids: list[str]
) -> None:
    unknown = ALIGNMENT | {"similarity": replace(SIMILARITY, knows_altitude=False).as_json()}
    reconstruct(service, scene, ids, alignment=unknown)
    path = f"/similarity/{ids[0]}"
    assert service.json("POST", path, params={"pose": "true"})["pose"]["altitude_m"] is None
    answer = service("POST", "/geopose", json=geopose_request(2))
    assert "no height" in problem(answer, 422, "no_pose")["detail"]


def test_a_track_takes_the_pose_of_a_frame_as_a_fix_unless_a_better_one_was_measured(
    service: Service, scene: ReconstructedScene, ids: list[str]
) -> None:
    path = f"/tracks/{service.json('POST', '/tracks', 201, json={})['track_id']}/frames"

    def fix_of(second: int, **fields: Any) -> dict[str, Any] | None:
        """The fix of a frame that has the features of the query."""
        started = service.json(
            "POST",
            path,
            202,
            files={"file": ("frame.jpg", photo_bytes(second))},
            data={"captured_at": f"2026-05-01T12:00:0{second}Z", **fields},
        )
        service.drain()
        key = query_features_key(UUID(started["job_id"]))
        with contextlib.nullcontext() if second else pytest.raises(NotFound):
            service.store.get(key)  # features only where poses have coordinates
        service.store.delete(key)
        if second:
            put_features(service.store, take_query(scene), key=key)
        frame = service.json("GET", started["frame_url"].removeprefix("/api/v1"))
        assert frame["status"] == "applied"
        with service.catalog.read() as session:
            evidence = session.get_one(TrackFrame, UUID(frame["frame_id"])).evidence
        assert evidence is not None
        found: dict[str, Any] | None = evidence["fix"]
        return found

    assert fix_of(0) is None
    reconstruct(service, scene, ids)
    place = ORIGIN.to_geographic(SIMILARITY.apply(CENTRE))
    measured = {"latitude": 45.2, "longitude": 7.7}
    for fields in ({}, {**measured, "accuracy_m": 15}):
        fix = fix_of(1 + len(fields), **fields)
        assert fix is not None
        at = (fix["latitude"], fix["longitude"])
        assert distance_m(place.latitude, place.longitude, *at) < 0.5
        assert 0 < fix["accuracy_m"] < 1
        assert fix["radius_95_m"] > fix["accuracy_m"]
        assert 0 <= fix["heading"] < 360
    exact = fix_of(5, **measured, accuracy_m=0.01)
    assert exact == {**measured, "accuracy_m": 0.01, "radius_95_m": None, "heading": None}
