"""Refusing work before anything fills up: the queue, the disk, what one gateway receives."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any
from uuid import UUID

import httpx2
import pytest
from fastapi import Request

from services.extractor.worker import ExtractorWorker
from services.gateway import admission
from services.gateway.admission import (
    MAX_RETRY_SECONDS,
    UNKNOWN_RATE_RETRY_SECONDS,
    AdmissionControl,
    UploadKind,
)
from services.gateway.authentication import Caller
from shared.catalog.database.base import db_now_plus
from shared.catalog.database.session import Catalog
from shared.catalog.jobs import Priority
from shared.catalog.maps import get_map
from shared.config.settings import Settings
from shared.errors import TooManyRequests
from shared.ids import new_id
from shared.jobs import Job, JobKind, JobState
from shared.jobs.queue_depth import THROUGHPUT_WINDOW_SECONDS, QueueDepth, measure_queue_depth
from shared.security.api_keys import ALL_SCOPES
from shared.storage import FolderStore
from tests.integration.in_process_api import Service
from tests.support.catalog_rows import add_job, add_map
from tests.support.photos import near_copy, photo_bytes
from tests.support.problems import problem

pytestmark = pytest.mark.databases("postgresql")

GIGABYTE = 1_000_000_000
Make = Callable[..., Service]


@pytest.fixture
def make_service(
    service: Service,
    catalog: Catalog,
    store: FolderStore,
    settings: Settings,
    make_worker: Callable[[], ExtractorWorker],
) -> Make:
    """Makes gateways with these limits on the one catalog, which has the maps default and city."""
    service.json("POST", "/maps", 201, json={"name": "city"})

    def make(**limits: Any) -> Service:
        return Service(catalog, store, settings.model_copy(update=limits), make_worker)

    return make


@pytest.fixture
def always_look(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(admission, "ADMISSION_POLL_SECONDS", 0.0)
    monkeypatch.setattr("shared.jobs.queue_depth.POLL_COST_DIVISOR", 0.0)


@pytest.fixture
def never_look_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(admission, "ADMISSION_POLL_SECONDS", 3600.0)


def upload(service: Service, number: int, map_name: str = "default") -> httpx2.Response:
    files = {"file": ("photo.jpg", photo_bytes(number))}
    return service("POST", "/upload", params={"map": map_name}, files=files)


def queue_full(answer: httpx2.Response) -> dict[str, Any]:
    body = problem(answer, 429, "queue_full")
    assert 1 <= int(answer.headers["retry-after"]) <= MAX_RETRY_SECONDS
    assert body["retry_after_seconds"] == int(answer.headers["retry-after"])
    return body


@pytest.mark.parametrize("looks", ["always_look", "never_look_again"])
def test_a_maps_queue_has_its_limit_and_another_map_its_own(
    make_service: Make, store: FolderStore, request: pytest.FixtureRequest, looks: str
) -> None:
    request.getfixturevalue(looks)
    service = make_service(max_queued_jobs=4)
    assert [upload(service, number).status_code for number in range(2)] == [202, 202]
    refused = queue_full(upload(service, 2))
    assert (refused["waiting"], refused["limit"]) == (2, 2)
    assert "'default'" in refused["detail"]
    assert len(list(store.list("originals/"))) == 2
    assert upload(service, 3, "city").status_code == 202


@pytest.mark.parametrize("looks", ["always_look", "never_look_again"])
def test_all_maps_together_have_a_limit_and_queries_pass_it(
    make_service: Make, request: pytest.FixtureRequest, looks: str
) -> None:
    request.getfixturevalue(looks)
    service = make_service(max_queued_jobs=2)
    assert upload(service, 1).status_code == 202
    assert upload(service, 2, "city").status_code == 202
    queue_full(upload(service, 3))
    queue_full(upload(service, 3, "city"))
    health = service("GET", "/health").json()
    assert health["status"] == health["parts"]["uploads"]["status"] == "degraded"
    assert "2 jobs are waiting, the limit is 2" in health["parts"]["uploads"]["detail"]
    assert service("GET", "/../../readyz").status_code == 200
    for call in ("/vocabularies", "/evaluations"):
        queue_full(service("POST", call))
    for number in range(3):
        assert service.ask(near_copy(number))


def test_a_full_queue_of_queries_refuses_no_upload(make_service: Make) -> None:
    service = make_service(max_queued_jobs=2)
    for number in range(10):
        service.ask(near_copy(number))
    files = {"file": ("query.jpg", near_copy(10))}
    body = queue_full(service("POST", "/similarity", files=files))
    assert body["limit"] == 10
    assert upload(service, 1).status_code == 202


@pytest.mark.usefixtures("always_look")
def test_a_full_queue_refuses_no_answer_that_makes_no_job(make_service: Make) -> None:
    service = make_service(max_queued_jobs=4)
    (photo,) = service.indexed(1)
    for number in (2, 3):
        upload(service, number)
    queue_full(upload(service, 4))
    assert service.json("POST", f"/similarity/{photo}")["total_similar"] == 0
    service.json("PATCH", f"/uploads/{photo}", json={"place": "kitchen"})
    service.json("DELETE", f"/uploads/{photo}")
    service.json("POST", "/maps", 201, json={"name": "empty"})


def test_the_queue_is_counted_up_to_a_limit_without_jobs_that_no_worker_could_claim(
    catalog: Catalog,
) -> None:
    with catalog.write() as session:
        one, other = add_map(session, "one").id, add_map(session, "other").id
        add_job(session, one)
        add_job(session, other)
        add_job(session, other, JobKind.EVALUATE)
        add_job(session, other, JobKind.DESCRIBE)
        add_job(session, one, JobKind.DESCRIBE)
        add_job(session, one, JobKind.FIT, waiting_for="descriptors")
        add_job(session, one, JobKind.REINDEX)
        for state in (JobState.SUCCEEDED, JobState.FAILED, JobState.CANCELLED):
            add_job(session, one, state=state)
        add_job(session, one, state=JobState.RUNNING, lease_token=one, lease_until=db_now_plus(60))
    with catalog.read() as session:
        seen = measure_queue_depth(session, 100)
        bounded = measure_queue_depth(session, 1)
    assert dict(seen.jobs_by_map) == {"one": 1, "other": 2}
    assert (seen.jobs, seen.queries) == (3, 2)
    assert (bounded.jobs, bounded.queries) == (1, 1)


def test_throughput_is_that_of_uploads_and_queries_finished_in_the_last_minute(
    catalog: Catalog,
) -> None:
    with catalog.write() as session:
        map_id = add_map(session).id
        for seconds, kind in (
            *((5, JobKind.INDEX),) * 20,
            *((5, JobKind.DESCRIBE),) * 10,
            (THROUGHPUT_WINDOW_SECONDS + 5, JobKind.INDEX),
            (5, JobKind.EVALUATE),
        ):
            add_job(
                session,
                map_id,
                kind,
                state=JobState.SUCCEEDED,
                finished_at=db_now_plus(-seconds),
            )
    with catalog.read() as session:
        assert (
            measure_queue_depth(session, 100).finished_per_second == 30 / THROUGHPUT_WINDOW_SECONDS
        )


@pytest.mark.parametrize(
    ("waiting", "per_second", "seconds"),
    [
        (1000, 10.0, 10),  # 100 too many for nine tenths
        (1500, 10.0, 60),  # 600 too many
        (1000, 1000.0, 1),
        (1000, 0.0, UNKNOWN_RATE_RETRY_SECONDS),  # no job has finished
    ],
)
def test_retry_after_follows_from_queue_length_and_throughput(
    waiting: int, per_second: float, seconds: int
) -> None:
    depth = QueueDepth({}, 0, finished=round(60 * per_second))
    with pytest.raises(TooManyRequests) as caught:
        admission._check_queue("jobs", waiting, 1000, depth)
    assert caught.value.extra["retry_after_seconds"] == seconds


def test_a_full_disk_refuses_uploads_alone(
    make_service: Make, store: FolderStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    service = make_service(min_free_bytes=GIGABYTE)
    (photo,) = service.indexed(1)
    track_id = service.json("POST", "/tracks", 201, json={})["track_id"]
    before = {info.key for info in store.list("")}
    free = SimpleNamespace(free=GIGABYTE - 1)
    monkeypatch.setattr("shared.config.disk_space.shutil.disk_usage", lambda folder: free)
    for path in ("/upload", "/vocabularies/import"):
        answer = service("POST", path, files={"file": photo_bytes(2)})
        body = problem(answer, 507, "disk_full")
        assert "MIN_FREE_BYTES" in body["detail"]
        assert int(answer.headers["retry-after"]) > 0
    problem(service("POST", "/vocabularies"), 507, "disk_full")
    problem(service("POST", "/tracks", json={}), 507, "disk_full")
    frame = {"files": {"file": photo_bytes(2)}, "data": {"captured_at": "2026-05-01T12:00:00Z"}}
    problem(service("POST", f"/tracks/{track_id}/frames", **frame), 507, "disk_full")
    assert {info.key for info in store.list("")} == before
    health = service("GET", "/health").json()
    assert health["status"] == health["parts"]["object_store"]["status"] == "degraded"
    assert "MIN_FREE_BYTES" in health["parts"]["object_store"]["detail"]
    assert service("GET", "/../../readyz").status_code == 200
    job_id = service.ask(near_copy(1))
    service.drain()
    assert service.json("GET", f"/jobs/{job_id}/result")["total_similar"] == 1
    free.free = GIGABYTE // 10 - 1
    answer = service("POST", "/similarity", files={"file": photo_bytes(2)})
    problem(answer, 507, "disk_full")
    assert service.json("POST", f"/similarity/{photo}")["total_similar"] == 0
    service.json("DELETE", f"/uploads/{photo}")
    free.free = GIGABYTE
    assert upload(service, 2).status_code == 202


def test_the_disk_of_the_originals_counts_too_and_no_disk_where_nothing_lies(
    settings: Settings, catalog: Catalog, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked_at: list[str] = []

    def usage(folder: Any) -> Any:
        looked_at.append(str(folder))
        return SimpleNamespace(free=5 if "photos" in str(folder) else 9)

    monkeypatch.setattr("shared.config.disk_space.shutil.disk_usage", usage)
    photos = settings.placewise_home.parent / "photos"
    photos.mkdir()
    elsewhere = settings.model_copy(update={"upload_dir": photos})
    assert AdmissionControl(catalog, elsewhere).disk.free_bytes() == 5
    assert AdmissionControl(catalog, settings).disk.free_bytes() == 9
    looked_at.clear()
    away = settings.model_copy(update={"s3_endpoint": "s3:1", "database_url": "postgresql://db"})
    assert AdmissionControl(catalog, away).disk.free_bytes() is None
    assert looked_at == []


def test_concurrent_uploads_of_a_gateway_are_limited(catalog: Catalog, settings: Settings) -> None:
    room = AdmissionControl(catalog, settings.model_copy(update={"max_concurrent_uploads": 2}))
    ours, theirs, third = (call_of(new_id(), f"192.0.2.{host}") for host in (1, 2, 3))
    with room.admit_upload(UploadKind.UPLOAD, ours), room.admit_upload(UploadKind.UPLOAD, theirs):
        with pytest.raises(TooManyRequests) as caught, room.admit_upload(UploadKind.UPLOAD, third):
            raise AssertionError("it was let in")
        assert caught.value.code == "too_many_uploads"
        with room.admit_upload(UploadKind.QUERY, ours):
            assert room.active_uploads(UploadKind.QUERY) == 1
    with pytest.raises(ZeroDivisionError), room.admit_upload(UploadKind.UPLOAD, ours):
        raise ZeroDivisionError
    assert room.active_uploads(UploadKind.UPLOAD) == 0


def call_of(key_id: UUID | None, address: str) -> Request:
    caller = Caller("whoever", ALL_SCOPES, key_id)
    return Request({"type": "http", "client": (address, 1), "state": {"caller": caller}})


def test_concurrent_uploads_of_a_key_and_of_an_address_are_limited(
    catalog: Catalog, settings: Settings
) -> None:
    room = AdmissionControl(catalog, settings.model_copy(update={"max_concurrent_uploads": 4}))
    key, other_key = new_id(), new_id()
    with (
        room.admit_upload(UploadKind.UPLOAD, call_of(key, "2001:db8::1")),
        room.admit_upload(UploadKind.UPLOAD, call_of(key, "192.0.2.1")),
    ):
        with (
            pytest.raises(TooManyRequests, match="of this key"),
            room.admit_upload(UploadKind.UPLOAD, call_of(key, "192.0.2.9")),
        ):
            raise AssertionError("one key was let in three times")
        with (
            room.admit_upload(UploadKind.UPLOAD, call_of(other_key, "2001:db8::2")),
            pytest.raises(TooManyRequests, match="of this address"),
            room.admit_upload(UploadKind.UPLOAD, call_of(None, "2001:db8::ffff")),
        ):
            raise AssertionError("one /64 was let in three times")
        with room.admit_upload(UploadKind.UPLOAD, call_of(None, "192.0.2.9")):
            assert room.active_uploads(UploadKind.UPLOAD) == 3
    with room.admit_upload(UploadKind.UPLOAD, call_of(key, "192.0.2.1")):
        assert room.active_uploads(UploadKind.UPLOAD) == 1, "places are given back"


@pytest.mark.usefixtures("always_look")
def test_health_reports_the_use_of_queues_and_disks(
    make_service: Make, catalog: Catalog, monkeypatch: pytest.MonkeyPatch
) -> None:
    receiving = {UploadKind.UPLOAD: 3, UploadKind.QUERY: 2}
    monkeypatch.setattr(AdmissionControl, "active_uploads", lambda _, kind: receiving[kind])
    service = make_service(max_queued_jobs=2200)
    with catalog.write() as session:
        city = get_map(session, "city").id
        session.add(Job(map_id=city, kind=JobKind.INDEX, priority=Priority.UPLOAD))
    service.ask(near_copy(1))
    load = service.json("GET", "/health")["load"]
    assert (load["waiting_jobs"], load["max_queued_jobs"]) == (1, 2200)
    assert (load["waiting_queries"], load["max_queued_queries"]) == (1, 11)
    assert (load["receiving_uploads"], load["receiving_queries"]) == (3, 2)
    assert load["free_bytes"] > 0
