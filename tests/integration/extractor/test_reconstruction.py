"""Reconstruction jobs on photos of a made-up scene: their steps, what they store, and resuming."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any
from uuid import UUID

import numpy as np
import pytest
from sqlalchemy import select

from services.extractor.geometry.job import ReconstructionJob
from services.extractor.worker import ExtractorWorker
from shared.catalog.jobs import Job, JobKind, JobState
from shared.catalog.maps import Map
from shared.catalog.photos import Photo
from shared.catalog.reconstructions import Reconstruction, get_reconstruction
from shared.errors import Unavailable
from shared.geodesy import distance_m
from shared.geometry.component import Component, quaternion_of
from shared.geometry.frames import EastNorthUp, Similarity
from shared.geometry.radius import PoseCalibration
from shared.integrity.verify import verify_store
from shared.storage.keys import component_key, matches_key
from tests.integration.in_process_api import Service
from tests.support.catalog_rows import failure_code, problem_of, result_of
from tests.support.local_features import MODEL, add_features
from tests.support.poses import ORIGIN, SIMILARITY
from tests.support.problems import problem
from tests.support.reconstructed_scene import ReconstructedScene

pytestmark = pytest.mark.numerics

PHOTOS = 8


@pytest.fixture(scope="module")
def scene() -> ReconstructedScene:
    return ReconstructedScene(photos=PHOTOS, points=300)


class Walk:
    """A map of the scene's photos, whose coordinates are those of the cameras."""

    def __init__(self, service: Service, scene: ReconstructedScene) -> None:
        self.service, self.scene = service, scene
        self.ids: list[UUID] = []

    def take(self, *numbers: int) -> list[UUID]:
        """Store photos of the scene with features and coordinates."""
        service, scene = self.service, self.scene
        taken = [UUID(each) for each in service.indexed(*numbers)]
        self.ids += taken
        features = list(scene.features.values())
        add_features(service.catalog, service.store, dict(zip(self.ids, features, strict=False)))
        centres = SIMILARITY.apply(scene.component.centres())
        with service.catalog.write() as session:
            for number, id_ in zip(numbers, taken, strict=True):
                photo, place = session.get_one(Photo, id_), ORIGIN.to_geographic(centres[number])
                photo.latitude, photo.longitude = place.latitude, place.longitude
                photo.altitude = place.altitude_m
                photo.filename = f"{number}.jpg"
                photo.captured_at = datetime(2026, 5, 1, tzinfo=UTC) + timedelta(minutes=number)
        return taken

    def start(self, **body: Any) -> UUID:
        return UUID(self.service.json("POST", "/reconstructions", 202, json=body)["job_id"])

    def run(self, worker: ExtractorWorker | None = None) -> None:
        """Run the queued reconstruction once, as far as it gets."""
        assert (worker or self.service.worker).fits.run_next(threading.Event())

    def job(self, job_id: UUID) -> Job:
        with self.service.catalog.read() as session:
            return session.get_one(Job, job_id)

    def reconstruct(self, **body: Any) -> Reconstruction:
        job_id = self.start(**body)
        self.run()
        job = self.job(job_id)
        assert job.state == JobState.SUCCEEDED, job.error
        return self.current()

    def current(self) -> Reconstruction:
        with self.service.catalog.read() as session:
            return get_reconstruction(session, session.scalars(select(Map.id)).one())

    def component(self, made: Reconstruction) -> Component:
        return Component.decode(self.service.store.get(component_key(made.id, 0)))

    def written(self, key: str) -> datetime | None:
        """When an object was written; None if it is missing."""
        info = self.service.store.head(key)
        return None if info is None else info.modified_at


@pytest.fixture
def walk(service: Service, scene: ReconstructedScene) -> Walk:
    walk = Walk(service, scene)
    walk.take(*range(PHOTOS - 2))
    return walk


def test_photos_are_reconstructed_aligned_to_their_coordinates_and_counted(walk: Walk) -> None:
    made = walk.reconstruct()
    assert walk.job(made.job_id).result == {
        "reconstruction_id": str(made.id),
        "photos": PHOTOS - 2,
        "reconstructed": PHOTOS - 2,
        "left_out": 0,
        "left_out_photos": [],
        "components": 1,
        "aligned": 1,
        "proposals": 0,
    }
    (component,) = made.list_components()
    assert (component.photos, made.imported, made.features_model) == (PHOTOS - 2, False, MODEL)
    assert component.points > 100
    assert component.mean_reprojection_error_pixels < 1
    assert component.not_aligned is None
    alignment = component.alignment
    assert alignment is not None
    assert alignment.rms_m < 0.1
    assert (alignment.agreeing, alignment.located) == (PHOTOS - 2, PHOTOS - 2)
    calibration = PoseCalibration.model_validate(component.calibration)
    assert calibration.poses >= 4
    assert calibration.share_found == pytest.approx(calibration.poses / (PHOTOS - 2))
    found = walk.component(made)
    origin, similarity = (
        EastNorthUp(*alignment.origin),
        Similarity.from_json(alignment.similarity),
    )
    with walk.service.catalog.read() as session:
        for photo_id, centre in zip(found.photo_ids, found.centres(), strict=True):
            photo, place = session.get_one(Photo, photo_id), similarity.apply(centre)
            where = origin.to_geographic(place)
            assert photo.latitude is not None
            assert photo.longitude is not None
            away = distance_m(photo.latitude, photo.longitude, where.latitude, where.longitude)
            assert away < 0.3
            assert where.altitude_m == pytest.approx(photo.altitude, abs=0.5)
    report = verify_store(walk.service.catalog, walk.service.store, originals=False)
    # The npz, and cameras, images, points, rigs and frames of COLMAP.
    assert report.checked["reconstruction"] == 6
    assert "reconstruction" not in {fault.what for fault in report.faults}


def test_later_run_registers_new_photos_with_what_is_known_of_the_others(
    walk: Walk, service: Service, scene: ReconstructedScene
) -> None:
    first = walk.reconstruct()
    new = walk.take(PHOTOS - 2, PHOTOS - 1)
    # Matched again, the first photos would look like nothing else.
    other = ReconstructedScene(photos=PHOTOS, points=300, seed=5)
    changed, unlike = dict(zip(walk.ids, scene.features.values(), strict=True)), walk.ids[:3]
    for id_, features in zip(unlike, other.features.values(), strict=False):
        count = len(changed[id_].descriptors)
        descriptors = np.resize(features.descriptors, (count, features.descriptors.shape[1]))
        changed[id_] = replace(changed[id_], descriptors=descriptors)
    add_features(service.catalog, service.store, changed)

    second = walk.reconstruct()
    assert second.id != first.id
    assert set(walk.component(second).photo_ids) == set(walk.ids)
    third = walk.reconstruct(from_scratch=True)
    assert {*walk.ids[3:], *new} == set(walk.component(third).photo_ids)


def test_component_is_reconstructed_again_after_one_of_its_photos_was_deleted(
    walk: Walk, service: Service
) -> None:
    walk.reconstruct()
    service.json("DELETE", f"/uploads/{walk.ids[0]}")
    made = walk.reconstruct()
    assert set(walk.component(made).photo_ids) == set(walk.ids[1:])


def test_extractor_without_pycolmap_says_what_to_install(
    walk: Walk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    job_id = walk.start()
    walk.run()
    job = walk.job(job_id)
    assert failure_code(job) == "pose_missing"
    assert "'.[pose]'" in problem_of(job)["detail"]


class FailingStore:
    """A store that fails to write objects whose key ends so."""

    def __init__(self, store: Any, ending: str) -> None:
        self._store, self._ending = store, ending

    def __getattr__(self, name: str) -> Any:
        return getattr(self._store, name)

    def put(self, key: str, data: bytes) -> None:
        if key.endswith(self._ending):
            raise Unavailable("store_unavailable", "The object store is away.")
        self._store.put(key, data)


def test_interrupted_job_continues_after_its_last_stored_step(
    walk: Walk, service: Service, make_worker: Callable[..., ExtractorWorker]
) -> None:
    job_id = walk.start()
    dying = make_worker()
    failing: Any = FailingStore(service.store, "/0.npz")
    dying.fits.context = replace(dying.context, store=failing)
    walk.run(dying)
    job = walk.job(job_id)
    assert (job.state, job.stage, job.attempts) == (JobState.QUEUED, "map", 0)
    with service.catalog.write() as session:
        begun = session.scalars(select(Reconstruction)).one()
        assert begun.components is None
        session.get_one(Job, job_id).run_after = None
    matched_at = walk.written(matches_key(begun.id))
    assert matched_at is not None
    problem(service("GET", "/reconstructions"), 404, "no_reconstruction")

    walk.run()
    assert walk.job(job_id).state == JobState.SUCCEEDED
    assert walk.current().id == begun.id
    assert walk.written(matches_key(begun.id)) == matched_at, "matched once"


def test_components_are_not_made_again_by_a_job_that_has_stored_them(
    walk: Walk, service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    attempts: list[int] = []

    def look(self: ReconstructionJob, *arguments: Any) -> Any:
        with service.catalog.write() as session:
            attempts.append(session.get_one(Job, self._job.id).attempts)
        return calibrate(self, *arguments)

    calibrate = ReconstructionJob._finish
    monkeypatch.setattr(ReconstructionJob, "_finish", look)
    job_id = walk.start()
    with service.catalog.write() as session:
        session.get_one(Job, job_id).attempts = 2
    walk.run()
    assert attempts == [0], "workers that died in the steps before do not count"
    made = walk.current()
    mapped_at = walk.written(component_key(made.id, 0))
    with service.catalog.write() as session:  # as if it had been killed while it aligned them
        row, job = session.get_one(Reconstruction, made.id), session.get_one(Job, made.job_id)
        row.finished_at = None
        job.state = JobState.QUEUED
    walk.run()
    again = walk.current()
    assert (again.id, again.components) == (made.id, made.components)
    assert walk.written(component_key(made.id, 0)) == mapped_at


def test_imported_model_gives_the_photos_its_poses(walk: Walk, service: Service) -> None:
    scene = walk.scene
    camera = scene.camera
    params = [camera.focal_pixels, camera.width / 2, camera.height / 2, 0.0]
    poses = zip(
        scene.component.rotations.tolist(), scene.component.translations.tolist(), strict=True
    )
    model = {
        "cameras": [
            {
                "model": "SIMPLE_RADIAL",
                "width": camera.width,
                "height": camera.height,
                "params": params,
            }
        ],
        "photos": [
            {"name": f"walk/{n}.jpg", "camera": 0, "rotation": rotation, "translation": translation}
            for n, (rotation, translation) in enumerate(poses)
        ],
        "origin": [-33.9, 18.4, 25.0],
    }
    started = service.json("POST", "/reconstructions/import", 202, json=model)
    walk.run()
    result = result_of(walk.job(UUID(started["job_id"])))
    assert (result["photos"], result["reconstructed"]) == (PHOTOS - 2, PHOTOS - 2)
    assert (result["unmatched"], result["unmatched_names"]) == (
        2,
        [f"walk/{PHOTOS - 2}.jpg", f"walk/{PHOTOS - 1}.jpg"],
    )
    made = walk.current()
    assert made.imported
    found = walk.component(made)
    for row, id_ in enumerate(found.photo_ids):
        number = walk.ids.index(id_)
        assert found.centres()[row] == pytest.approx(scene.component.centres()[number], abs=1e-6)
        same = abs(quaternion_of(found.rotation(row)) @ scene.component.rotations[number])
        assert same == pytest.approx(1, abs=1e-9)
    (about,) = made.list_components()
    assert about.alignment is not None, about.not_aligned
    assert about.alignment.origin == (-33.9, 18.4, 25.0)
    placed = Similarity.from_json(about.alignment.similarity).apply(found.centres())
    assert placed == pytest.approx(found.centres()), "the model's axes are east, north and up"


def test_imported_model_of_other_photos_is_refused_before_anything_is_matched(
    walk: Walk, service: Service
) -> None:
    pose = {"camera": 0, "rotation": [1, 0, 0, 0], "translation": [0, 0, 0]}
    camera = {"model": "PINHOLE", "width": 64, "height": 48, "params": [50, 50, 32, 24]}
    model = {"cameras": [camera], "photos": [{"name": f"other{n}", **pose} for n in range(3)]}
    started = service.json("POST", "/reconstructions/import", 202, json=model)
    walk.run()
    job = walk.job(UUID(started["job_id"]))
    assert (failure_code(job), job.kind) == ("names_unmatched", JobKind.RECONSTRUCT)
    assert "other0" in problem_of(job)["detail"]
    with service.catalog.read() as session:
        begun = session.scalars(select(Reconstruction)).one()
    assert walk.written(matches_key(begun.id)) is None
