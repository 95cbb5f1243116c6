"""Photos sent straight to the bucket: announced, put, completed; and everything that can differ."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any
from uuid import UUID

import httpx2
import pytest
import urllib3
from sqlalchemy import delete, func, select, update

from services.extractor.worker import ExtractorWorker
from services.steward.tasks.delete_maps import purge_deleted_maps
from services.steward.tasks.garbage_collection import collect_presigned_uploads
from services.steward.tasks.orphans import collect_orphans
from shared.catalog.database.base import db_now_plus
from shared.catalog.database.session import Catalog
from shared.catalog.idempotency import StoredResponse
from shared.catalog.photos import Photo, PresignedUpload
from shared.config.settings import Settings
from shared.storage import FolderStore
from shared.storage.keys import JOURNAL, TRASH
from shared.storage.s3 import S3Store
from tests.integration.in_process_api import Service
from tests.support.photos import photo_bytes
from tests.support.problems import field_refused, problem
from tests.support.servers import S3Server

PHOTO = photo_bytes(1)


@pytest.fixture(params=["s3", "moto"])
def store(request: pytest.FixtureRequest) -> S3Store:
    server: S3Server = request.getfixturevalue(request.param)
    return S3Store(server.new_bucket())


lenient = pytest.mark.parametrize("store", ["moto"], indirect=True)
strict = pytest.mark.parametrize("store", ["s3"], indirect=True)


def presign(
    service: Service, photo: bytes = PHOTO, map_name: str = "default", **fields: Any
) -> dict[str, Any]:
    """An announced upload."""
    file = {
        "filename": "street.jpg",
        "file_size": len(photo),
        "sha256": hashlib.sha256(photo).hexdigest(),
    }
    answer: dict[str, Any] = service.json(
        "POST", "/uploads/presign", 201, params={"map": map_name}, json={**file, **fields}
    )
    assert answer["method"] == "PUT"
    return answer


def put(upload: dict[str, Any], data: bytes = PHOTO) -> int:
    headers = {**upload["headers"], "Content-Length": str(len(data))}
    return urllib3.request("PUT", upload["url"], body=data, headers=headers, retries=False).status


def complete(service: Service, upload: dict[str, Any], **options: Any) -> httpx2.Response:
    return service("POST", upload["complete_url"].removeprefix("/api/v1"), **options)


def keys(store: S3Store, prefix: str = "") -> set[str]:
    return {info.key for info in store.list(prefix) if prefix or not info.key.startswith(TRASH)}


def photos(catalog: Catalog) -> int:
    with catalog.read() as session:
        return session.scalar(select(func.count()).select_from(Photo)) or 0


@lenient
def test_the_urls_of_a_direct_upload_lead_to_its_map(service: Service) -> None:
    service.json("POST", "/maps", 201, json={"name": "other", "extractor": "test-tiny-avg"})
    upload = presign(service, map_name="other")
    assert put(upload) == 200
    answer = complete(service, upload)
    again = complete(service, upload)
    for one in (answer, again):
        assert one.status_code == 202, one.text
        assert one.headers["location"] == one.json()["status_url"]
        service.json("GET", one.headers["location"].removeprefix("/api/v1"))


def test_a_photo_sent_straight_to_the_bucket_is_stored_described_and_found(
    service: Service, store: S3Store
) -> None:
    fields: dict[str, Any] = {
        "latitude": 45.5,
        "longitude": 7.5,
        "tags": ["a", "b"],
        "metadata": {"n": 1},
    }
    fields["filename"] = "../../etc/C:\\photos\\street.jpg"
    upload = presign(service, **fields, captured_at="2026-05-01T12:00:00", heading=360)
    assert "street" not in upload["url"], "a file name is never a path"
    assert put(upload) == 200
    answer = complete(service, upload)
    assert answer.status_code == 202, answer.text
    body = answer.json()
    assert answer.headers["location"] == body["status_url"]
    assert (body["filename"], body["file_size"]) == ("street.jpg", len(PHOTO))
    assert body["already_there"] is False
    service.drain()
    photo = service.json("GET", f"/uploads/{body['file_id']}")
    assert photo["searchable"]
    del fields["filename"]
    assert {name: photo[name] for name in fields} == fields
    assert (photo["heading"], photo["captured_at"]) == (0, "2026-05-01T12:00:00Z")
    assert service("GET", f"/uploads/{body['file_id']}/image").content == PHOTO
    assert keys(store, "incoming/") == set()
    assert len(keys(store, "originals/")) == 1


@pytest.mark.databases("sqlite", "postgresql")
def test_completing_many_times_at_once_gives_one_answer_and_one_photo(
    service: Service, store: S3Store, catalog: Catalog
) -> None:
    upload = presign(service)
    put(upload)
    together = threading.Barrier(6)

    def one(_: int) -> httpx2.Response:
        together.wait(timeout=30)
        return complete(service, upload)

    with ThreadPoolExecutor(6) as pool:
        answers = list(pool.map(one, range(6)))
    assert len({(answer.status_code, answer.text) for answer in answers}) == 1
    assert answers[0].status_code == 202, answers[0].text
    assert (photos(catalog), len(keys(store, "originals/"))) == (1, 1)


def test_completing_again_gives_the_same_answer_whatever_was_sent_since(
    service: Service, store: S3Store, catalog: Catalog
) -> None:
    upload = presign(service)
    put(upload)
    first = complete(service, upload)
    file_id = first.json()["file_id"]
    assert put(upload) == 200, "the URL is still good"
    store.put(f"incoming/{upload['upload_id']}", photo_bytes(2))
    service.drain()
    assert service("GET", f"/uploads/{file_id}/image").content == PHOTO
    assert service.json("GET", f"/uploads/{file_id}")["searchable"]
    again = complete(service, upload)
    assert (again.status_code, again.text) == (202, first.text)
    assert again.headers["location"] == first.headers["location"]
    assert again.headers["idempotent-replayed"] == "true"
    assert (photos(catalog), len(keys(store, "originals/"))) == (1, 1)
    with catalog.write() as session:
        session.execute(delete(StoredResponse))  # as after a day
    problem(complete(service, upload), 404, "upload_not_found")
    assert service("GET", f"/uploads/{file_id}/image").content == PHOTO


@lenient
@pytest.mark.parametrize(
    ("sent", "code"),
    [
        (PHOTO + b"more", "size_differs"),
        (PHOTO[:-1], "size_differs"),
        (bytes(len(PHOTO)), "sha256_differs"),
    ],
    ids=["longer", "shorter", "other bytes"],
)
def test_bytes_that_differ_from_the_announced_ones_are_refused_and_may_be_sent_again(
    service: Service, store: S3Store, catalog: Catalog, sent: bytes, code: str
) -> None:
    upload = presign(service)
    put(upload, sent)
    refused = problem(complete(service, upload), 422, code)
    assert "again" in refused["detail"]
    assert (photos(catalog), keys(store, "originals/")) == (0, set())
    put(upload)
    assert complete(service, upload).status_code == 202


@strict
def test_a_store_that_checks_what_is_signed_takes_nothing_else(
    service: Service, store: S3Store
) -> None:
    upload = presign(service)
    for other in (PHOTO + b"more", PHOTO[:-1], bytes(len(PHOTO))):
        assert put(upload, other) in (400, 403)
    assert {key for key in keys(store) if not key.startswith(JOURNAL)} == set()
    problem(complete(service, upload), 409, "upload_incomplete")
    assert put(upload) == 200
    assert complete(service, upload).status_code == 202


@pytest.mark.parametrize(
    ("sent", "status", "code"),
    [
        (b"no photo at all, but text" * 10, 415, "unsupported_photo"),
        (b"\xff\xd8\xff" + bytes(5000), 422, "undecodable_photo"),
        (photo_bytes(3, "PNG"), 422, "too_many_pixels"),
    ],
    ids=["text", "broken", "too many pixels"],
)
def test_what_is_no_photo_is_refused_and_leaves_no_original(
    service: Service,
    store: S3Store,
    catalog: Catalog,
    sent: bytes,
    status: int,
    code: str,
) -> None:
    settings = service.settings.model_copy(update={"max_image_pixels": 100})
    service = Service(catalog, store, settings, service.make_worker)
    upload = presign(service, sent)
    assert put(upload, sent) == 200
    problem(complete(service, upload), status, code)
    assert (photos(catalog), keys(store, "originals/")) == (0, set())


def test_bytes_that_are_already_stored_are_answered_with_their_photo(
    service: Service, store: S3Store
) -> None:
    there = service.upload(PHOTO, latitude=45, longitude=7)
    service.drain()
    upload = presign(service)
    put(upload)
    answer = complete(service, upload)
    assert (answer.status_code, answer.json()["file_id"]) == (200, there["file_id"])
    assert answer.json()["already_there"] is True
    differs = presign(service, latitude=46, longitude=7)
    put(differs)
    refused = problem(complete(service, differs), 409, "photo_differs")
    assert refused["file_id"] == there["file_id"]
    assert len(keys(store, "originals/")) == 1


def test_an_expired_upload_is_refused_and_its_bytes_are_collected(
    service: Service, store: S3Store, catalog: Catalog
) -> None:
    upload, retained = presign(service), presign(service, photo_bytes(2))
    put(upload)
    put(retained, photo_bytes(2))
    with catalog.write() as session:
        session.execute(
            update(PresignedUpload)
            .where(PresignedUpload.id == UUID(upload["upload_id"]))
            .values(expires_at=db_now_plus(-1))
        )
    problem(complete(service, upload), 410, "upload_expired")
    assert photos(catalog) == 0
    collect_presigned_uploads(catalog, store)
    assert keys(store) == {f"incoming/{retained['upload_id']}"}
    problem(complete(service, upload), 404, "upload_not_found")
    assert complete(service, retained).status_code == 202


def test_orphans_under_incoming_go_and_what_is_awaited_stays(
    service: Service, store: S3Store, catalog: Catalog
) -> None:
    awaited, completed = presign(service), presign(service, photo_bytes(2))
    put(awaited)
    put(completed, photo_bytes(2))
    complete(service, completed)
    put(completed, photo_bytes(2))
    store.put("incoming/01a1fca4-c1a2-7356-bf32-75e1cb64beb1", b"of no row")
    store.put("incoming/stray", b"of no upload")
    before = keys(store, "originals/")
    collect_orphans(catalog, store, age_seconds=-60)
    assert keys(store, "incoming/") == {f"incoming/{awaited['upload_id']}"}
    assert keys(store, "originals/") == before


def test_a_deleted_maps_uploads_go_with_it(
    service: Service, store: S3Store, catalog: Catalog
) -> None:
    service.json("POST", "/maps", 201, json={"name": "city"})
    file = {"filename": "a.jpg", "file_size": 10, "sha256": "0" * 64}
    upload = service.json("POST", "/uploads/presign", 201, params={"map": "city"}, json=file)
    store.put(f"incoming/{upload['upload_id']}", b"x" * 10)
    problem(
        complete(service, upload, params={"map": "default"}), 404, "upload_not_found"
    )  # of another map
    service.json("DELETE", "/maps/city")
    problem(complete(service, upload, params={"map": "city"}), 404, "map_not_found")
    for _ in range(5):
        purge_deleted_maps(catalog, store)
    assert {key for key in keys(store) if not key.startswith(JOURNAL)} == set()
    with catalog.read() as session:
        assert session.scalars(select(PresignedUpload.id)).all() == []


def test_presigning_can_be_repeated_under_a_key(service: Service, catalog: Catalog) -> None:
    file = {"filename": "a.jpg", "file_size": 10, "sha256": "0" * 64}
    answers = [
        service("POST", "/uploads/presign", json=file, headers={"Idempotency-Key": "k"})
        for _ in range(2)
    ]
    assert [answer.status_code for answer in answers] == [201, 201]
    assert answers[0].json() == answers[1].json()
    with catalog.read() as session:
        assert len(session.scalars(select(PresignedUpload.id)).all()) == 1


@lenient
def test_what_can_not_be_stored_is_refused_before_anything_is_sent(
    service: Service, catalog: Catalog, settings: Settings
) -> None:
    file = {"filename": "a.jpg", "file_size": 10, "sha256": "0" * 64}
    for changed, field in (
        ({"sha256": "A" * 64}, "sha256"),
        ({"file_size": 0}, "file_size"),
        ({"latitude": 45}, "longitude"),
        ({"unknown": 1}, "unknown"),
    ):
        field_refused(service("POST", "/uploads/presign", json={**file, **changed}), field)
    large = {**file, "file_size": settings.max_file_size + 1}
    problem(service("POST", "/uploads/presign", json=large), 413, "file_too_large")
    with catalog.read() as session:
        assert session.scalars(select(PresignedUpload.id)).all() == []


@lenient
def test_an_unknown_upload_is_not_found(service: Service) -> None:
    for upload_id in ("01a1fca4-c1a2-7356-bf32-75e1cb64beb1", "no-id"):
        answer = service("POST", f"/uploads/presign/{upload_id}/complete")
        problem(answer, 404, "upload_not_found")


def test_a_folder_store_refuses_direct_uploads_and_names_the_upload_route(
    catalog: Catalog,
    settings: Settings,
    make_worker: Callable[[], ExtractorWorker],
    service: Service,
) -> None:
    folder = FolderStore(settings.placewise_home / "objects")
    embedded = Service(catalog, folder, settings, make_worker)
    file = {"filename": "a.jpg", "file_size": 10, "sha256": "0" * 64}
    refused = problem(embedded("POST", "/uploads/presign", json=file), 409, "no_direct_uploads")
    assert "POST /api/v1/upload" in refused["detail"]
