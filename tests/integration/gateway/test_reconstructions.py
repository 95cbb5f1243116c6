"""Reconstructions over HTTP: what may be made, and how one is read, exported and accepted."""

from __future__ import annotations

import io
import struct
import tarfile
from typing import Any
from uuid import UUID

import pytest
from sqlalchemy import select

from shared.catalog.generations import Generation
from shared.catalog.jobs import Job, JobKind
from shared.catalog.photos import Photo
from shared.catalog.reconstructions import MAX_PHOTOS, ReconstructedComponent, Reconstruction
from shared.geometry.colmap_model import ColmapModel
from shared.storage.keys import reconstruction_prefix
from tests.integration.gateway.test_response_urls import COLMAP
from tests.integration.in_process_api import Service
from tests.support.catalog_rows import add_reconstruction
from tests.support.local_features import MODEL, add_features, scene_features
from tests.support.poses import ALIGNMENT, CALIBRATION
from tests.support.problems import problem

POSE = {"camera": 0, "rotation": [1, 0, 0, 0], "translation": [0, 0, 0]}


@pytest.fixture
def ids(service: Service) -> list[UUID]:
    """Three photos with local features."""
    ids = [UUID(each) for each in service.indexed(1, 2, 3, latitude=45, longitude=7)]
    add_features(service.catalog, service.store, {id_: scene_features(1) for id_ in ids})
    return ids


def add(service: Service, **columns: Any) -> Reconstruction:
    with service.catalog.write() as session:
        generation = session.scalars(select(Generation)).one()
        return add_reconstruction(
            session, service.store, generation, **{"features_model": MODEL, **columns}
        )


@pytest.mark.databases("sqlite", "postgresql")
def test_reconstruction_is_a_job_of_which_a_map_has_one_at_a_time(
    service: Service, ids: list[UUID]
) -> None:
    started = service.json("POST", "/reconstructions", 202, json={"from_scratch": True})
    with service.catalog.read() as session:
        job = session.get_one(Job, UUID(started["job_id"]))
        assert (job.kind, job.params) == (
            JobKind.RECONSTRUCT,
            {"object_key": None, "from_scratch": True},
        )
    (listed,) = service.json("GET", "/jobs", params={"kind": "reconstruct"})["jobs"]
    assert (listed["label"], listed["state"]) == ("Reconstruction", "queued")
    again = problem(service("POST", "/reconstructions"), 409, "reconstruction_running")
    cancel = f"/jobs/{again['job_id']}/cancel?map=default"
    assert f"POST /api/v1{cancel}." in again["detail"]
    service.json("POST", cancel)
    service.json("POST", "/reconstructions", 202)


def test_map_that_can_not_be_reconstructed_is_refused_with_what_to_do(service: Service) -> None:
    service.json("POST", "/maps", 201, json={"name": "plain", "matching": "off"})
    plain = {"map": "plain"}
    problem(service("POST", "/reconstructions", params=plain), 409, "too_few_photos")
    service.indexed(1, 2, 3, map_name="plain")
    refused = problem(service("POST", "/reconstructions", params=plain), 409, "no_local_features")
    assert "--matching on" in refused["detail"]
    refused = problem(
        service("POST", "/reconstructions/import", params=plain, json=COLMAP),
        409,
        "no_local_features",
    )


def test_map_with_more_photos_than_a_reconstruction_takes_is_refused(
    service: Service, ids: list[UUID], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("shared.catalog.reconstructions.MAX_PHOTOS", 2)
    refused = problem(service("POST", "/reconstructions"), 409, "too_many_photos")
    assert "takes at most 2" in refused["detail"]
    assert MAX_PHOTOS >= 1000


def test_imported_model_is_stored_until_its_job_has_ended(
    service: Service, ids: list[UUID]
) -> None:
    started = service.json("POST", "/reconstructions/import", 202, json=COLMAP)
    with service.catalog.read() as session:
        params = session.get_one(Job, UUID(started["job_id"])).params
    assert params["from_scratch"]
    stored = ColmapModel.model_validate_json(service.store.get(params["object_key"]))
    assert stored == ColmapModel.model_validate(COLMAP)


@pytest.mark.parametrize(
    "change",
    [
        {"cameras": [{**COLMAP["cameras"][0], "model": "PERIDOT"}]},
        {"cameras": [{**COLMAP["cameras"][0], "params": [50]}]},
        {"cameras": [{**COLMAP["cameras"][0], "params": [-50, 50, 32, 24]}]},
        {"cameras": []},
        {"photos": COLMAP["photos"][:2]},
        {"photos": [*COLMAP["photos"], {**POSE, "name": "0.jpg"}]},
        {"photos": [*COLMAP["photos"], {**POSE, "name": "4.jpg", "camera": 1}]},
        {"photos": [*COLMAP["photos"], {**POSE, "name": "4.jpg", "rotation": [1, 1, 0, 0]}]},
        {"photos": [*COLMAP["photos"], {**POSE, "name": "4\n.jpg"}]},
        {"points": []},
    ],
)
def test_model_that_makes_no_sense_is_refused(
    service: Service, ids: list[UUID], change: dict[str, Any]
) -> None:
    problem(
        service("POST", "/reconstructions/import", json={**COLMAP, **change}), 422, "invalid_field"
    )
    with service.catalog.read() as session:
        assert session.scalar(select(Job).where(Job.kind == JobKind.RECONSTRUCT)) is None


def test_components_say_how_they_are_aligned_and_calibrated_or_why_not(
    service: Service, ids: list[UUID]
) -> None:
    problem(service("GET", "/reconstructions"), 404, "no_reconstruction")
    made = add(service)
    (plain,) = made.list_components()
    known = {"alignment": ALIGNMENT, "calibration": CALIBRATION, "not_aligned": None}
    aligned = ReconstructedComponent.model_validate({**plain.model_dump(), **known})
    with service.catalog.write() as session:
        row = session.get_one(Reconstruction, made.id)
        row.components = [aligned.model_dump(mode="json"), plain.model_dump(mode="json")]
    answer = service.json("GET", "/reconstructions")
    assert answer["reconstruction_id"] == str(made.id)
    assert (answer["proposals"], answer["imported"], answer["features_model"]) == (0, False, MODEL)
    first, second = answer["components"]
    latitude, longitude, altitude = ALIGNMENT["origin"]
    assert (first["latitude"], first["longitude"], first["altitude_m"]) == (
        latitude,
        longitude,
        altitude,
    )
    assert (first["metres_per_unit"], first["alignment_rms_m"]) == (2.5, 0.5)
    assert (first["agreeing"], first["located"], first["is_on_line"]) == (9, 12, False)
    assert (second["agreeing"], second["located"], second["is_on_line"]) == (None, None, None)
    assert (first["not_aligned"], first["calibration"]) == (None, CALIBRATION)
    assert second["not_aligned"] == "No photo has coordinates."
    assert {second[name] for name in ("latitude", "metres_per_unit", "calibration")} == {None}


def test_reconstruction_of_other_local_features_is_not_current(
    service: Service, ids: list[UUID]
) -> None:
    current = add(service)
    add(service, finished_at=None)
    assert service.json("GET", "/reconstructions")["reconstruction_id"] == str(current.id)
    with service.catalog.write() as session:
        session.get_one(Reconstruction, current.id).features_model = "other@1"
    answer = problem(service("GET", "/reconstructions"), 404, "no_reconstruction")
    assert "of local features of other@1" in answer["detail"]


def test_proposals_are_accepted_and_undone_by_changing_the_photo(
    service: Service, ids: list[UUID]
) -> None:
    first, second, third = ids
    proposal = {
        "latitude": 45.0,
        "longitude": 7.0,
        "proposed_latitude": 45.001,
        "proposed_longitude": 7.0,
        "distance_m": 111.2,
        "radius_95_m": 5.0,
    }
    made = add(
        service,
        proposals=[
            {"photo_id": str(first), **proposal},
            {"photo_id": str(second), **proposal, "distance_m": 200.0},
            {"photo_id": str(third), **proposal},
        ],
    )
    service.json("PATCH", f"/uploads/{third}", json={"latitude": 44, "longitude": 7})
    path = f"/reconstructions/{made.id}/proposals"

    def listed() -> list[tuple[str, bool]]:
        found = service.json("GET", path)["proposals"]
        return [(each["image_id"], each["accepted"]) for each in found]

    assert listed() == [(str(second), False), (str(first), False)]
    assert service.json("GET", "/reconstructions")["proposals"] == 2
    service.json("PATCH", f"/uploads/{first}", json={"latitude": 45.001, "longitude": 7.0})
    assert listed() == [(str(second), False), (str(first), True)]
    assert service.json("GET", "/reconstructions")["proposals"] == 1
    service.json("PATCH", f"/uploads/{first}", json={"latitude": 45.0, "longitude": 7.0})
    assert listed() == [(str(second), False), (str(first), False)]
    service.json("DELETE", f"/uploads/{second}")
    assert listed() == [(str(first), False)]


def image_file(*names: str) -> bytes:
    """`images.bin` of images with one keypoint each."""
    images = [
        struct.pack("<I7dI", number, 1, 0, 0, 0, *(3 * [0.5]), 1)
        + name.encode()
        + b"\0"
        + struct.pack("<Q2dQ", 1, 10.0, 20.0, 7)
        for number, name in enumerate(names, start=1)
    ]
    return struct.pack("<Q", len(images)) + b"".join(images)


def test_export_names_the_photos_by_their_paths_where_these_are_unique(
    service: Service, ids: list[UUID]
) -> None:
    made = add(service)
    gone = "01a21646-d7c5-7068-a746-0e7d21b164f4"
    with service.catalog.write() as session:
        first, second, third = (session.get_one(Photo, id_) for id_ in ids)
        first.relative_path = "Day 2/\N{LATIN SMALL LETTER E WITH ACUTE}.jpg"
        second.filename = third.filename = "same.jpg"
    prefix = f"{reconstruction_prefix(made.id)}0/"
    service.store.put(f"{prefix}images.bin", image_file(*map(str, ids), gone))
    service.store.put(f"{prefix}points3D.bin", b"points")
    answer = service("GET", f"/reconstructions/{made.id}/colmap")
    assert answer.headers["content-type"] == "application/x-tar"
    with tarfile.open(fileobj=io.BytesIO(answer.content), mode="r:") as tar:
        assert tar.getnames() == ["0/images.bin", "0/points3D.bin"]
        images, points = (tar.extractfile(name) for name in tar.getnames())
        assert images is not None
        assert points is not None
        names = ("Day 2/\N{LATIN SMALL LETTER E WITH ACUTE}.jpg", str(ids[1]), str(ids[2]), gone)
        assert images.read() == image_file(*names)
        assert points.read() == b"points"


def test_unfinished_reconstruction_is_not_found(service: Service, ids: list[UUID]) -> None:
    made = add(service, finished_at=None)
    for path in ("colmap", "proposals"):
        answer = service("GET", f"/reconstructions/{made.id}/{path}")
        problem(answer, 404, "reconstruction_not_found")
    problem(service("GET", "/reconstructions/abc/colmap"), 404, "reconstruction_not_found")
