"""`Idempotency-Key` over HTTP: a repeated call is done once and answered the same."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import httpx2
import pytest
from sqlalchemy import func, select

from services.extractor.worker import ExtractorWorker
from services.gateway.routes import model_changes
from shared.catalog.database.session import Catalog
from shared.catalog.idempotency import StoredResponse
from shared.catalog.photos import Photo
from shared.config.settings import Settings
from shared.errors import Unavailable
from shared.jobs import Job
from shared.storage import FolderStore
from tests.integration.api_with_keys import Door
from tests.integration.in_process_api import Service
from tests.support.photos import near_copy, photo_bytes
from tests.support.problems import field_refused, problem
from tests.support.threads import at_once

pytestmark = pytest.mark.databases("postgresql")

REPLAYED = "idempotent-replayed"


def keyed(key: str = "key-1", **headers: str) -> dict[str, str]:
    return {"Idempotency-Key": key, **headers}


def upload(service: Service, photo: bytes, key: str = "key-1", **options: Any) -> httpx2.Response:
    files = {"file": (options.pop("name", "photo.jpg"), photo)}
    headers = keyed(key, **options.pop("headers", {}))
    return service("POST", "/upload", files=files, headers=headers, **options)


def count(catalog: Catalog, table: type[Job] | type[Photo] | type[StoredResponse]) -> int:
    with catalog.read() as session:
        return session.scalar(select(func.count()).select_from(table)) or 0


def originals(store: FolderStore) -> int:
    return sum(1 for _ in store.list("originals/"))


def same(first: httpx2.Response, again: httpx2.Response) -> None:
    assert REPLAYED not in first.headers
    assert again.headers[REPLAYED] == "true"
    assert (again.status_code, again.text) == (first.status_code, first.text)
    for name in ("location", "retry-after", "content-type"):
        assert again.headers.get(name) == first.headers.get(name), name


def call_fit(service: Service, **options: Any) -> httpx2.Response:
    return service("POST", "/vocabularies", json={"clusters": 4}, **options)


def call_map(service: Service, **options: Any) -> httpx2.Response:
    return service("POST", "/maps", json={"name": "city"}, **options)


def call_batch(service: Service, **options: Any) -> httpx2.Response:
    files = [("file", (f"{number}.jpg", photo_bytes(number))) for number in (1, 2)]
    return service("POST", "/upload/batch", files=files, **options)


def call_evaluation(service: Service, **options: Any) -> httpx2.Response:
    return service("POST", "/evaluations", **options)


def call_query(service: Service, **options: Any) -> httpx2.Response:
    return service("POST", "/similarity", files={"file": ("a.jpg", near_copy(1))}, **options)


def call_upload(service: Service, **options: Any) -> httpx2.Response:
    return service("POST", "/upload", files={"file": ("b.jpg", photo_bytes(9))}, **options)


def call_switch(service: Service, **options: Any) -> httpx2.Response:
    return service("POST", "/generations", json={"vocabulary_id": None}, **options)


def call_import(service: Service, **options: Any) -> httpx2.Response:
    files = {"file": ("centres.npy", b"\x93NUMPY whatever the extractor will say of it")}
    return service("POST", "/vocabularies/import", files=files, **options)


CALLS: dict[str, tuple[int, Callable[..., httpx2.Response]]] = {
    "maps": (201, call_map),
    "similarity": (202, call_query),
    "vocabularies": (202, call_fit),
    "import": (202, call_import),
    "generations": (202, call_switch),
    "evaluations": (202, call_evaluation),
    "batch": (202, call_batch),
}
every_call = pytest.mark.parametrize(("status", "call"), CALLS.values(), ids=CALLS)


@every_call
def test_a_repeated_call_is_done_once_and_answered_the_same(
    service: Service, catalog: Catalog, status: int, call: Callable[..., httpx2.Response]
) -> None:
    service.indexed(1, latitude=45, longitude=7)
    first = call(service, headers=keyed())
    assert first.status_code == status, first.text
    jobs = count(catalog, Job)
    same(first, call(service, headers=keyed()))
    assert count(catalog, Job) == jobs
    assert count(catalog, StoredResponse) == 1


@pytest.mark.parametrize("what", ["cancel", "retry"])
def test_cancelling_and_retrying_can_be_repeated(service: Service, what: str) -> None:
    job = service.upload(photo_bytes(1))["job_id"]
    if what == "retry":
        service.json("POST", f"/jobs/{job}/cancel")
    first = service("POST", f"/jobs/{job}/{what}", headers=keyed())
    assert first.status_code == 200, first.text
    same(first, service("POST", f"/jobs/{job}/{what}", headers=keyed()))


def test_calls_without_a_key_are_each_carried_out(service: Service, catalog: Catalog) -> None:
    service.indexed(1, latitude=45, longitude=7)
    jobs = {call_evaluation(service).json()["job_id"] for _ in range(2)}
    assert len(jobs) == 2
    assert count(catalog, StoredResponse) == 0


def test_an_upload_whose_answer_was_lost_gives_the_same_ids_and_stores_once(
    service: Service, catalog: Catalog, store: FolderStore
) -> None:
    data = photo_bytes(1)
    first = upload(service, data)
    assert first.status_code == 202
    # The multipart boundary is another one each time; the content is what counts.
    same(first, upload(service, data))
    service.drain()
    same(first, upload(service, data))
    assert (count(catalog, Photo), count(catalog, Job), originals(store)) == (1, 1, 1)


def test_another_upload_under_the_key_is_refused_and_leaves_nothing(
    service: Service, catalog: Catalog, store: FolderStore
) -> None:
    assert upload(service, photo_bytes(1)).status_code == 202
    for another in (
        upload(service, photo_bytes(2)),
        upload(service, photo_bytes(1), data={"latitude": "45", "longitude": "7"}),
        upload(service, photo_bytes(1), name="other.jpg"),
        call_map(service, headers=keyed()),
    ):
        problem(another, 422, "idempotency_key_reused")
    assert (count(catalog, Photo), originals(store)) == (1, 1)


def test_two_maps_may_choose_the_same_key_and_the_default_map_may_be_named(
    service: Service,
) -> None:
    service.json("POST", "/maps", 201, json={"name": "city"})
    first = upload(service, photo_bytes(1))
    same(first, upload(service, photo_bytes(1), params={"map": "default"}))
    there = upload(service, photo_bytes(1), params={"map": "city"})
    assert (first.status_code, there.status_code) == (202, 202)
    assert REPLAYED not in there.headers


def test_two_callers_may_choose_the_same_key(door: Door) -> None:
    mine, yours = (door.key("write")["key"] for _ in range(2))
    photo = {"file": ("photo.jpg", photo_bytes(1))}
    first, again, other = (
        door(key, "POST", "/upload", files=photo, headers=keyed()) for key in (mine, mine, yours)
    )
    assert first.status_code == 202
    same(first, again)
    assert other.json()["already_there"], "a call of its own, which found the other's photo"
    assert REPLAYED not in other.headers


def test_an_upload_that_waited_is_answered_with_its_job_when_it_is_repeated(
    service: Service,
) -> None:
    wait = {"Prefer": "wait=30"}
    with ThreadPoolExecutor(1) as pool:
        searched = pool.submit(upload, service, photo_bytes(1), headers=wait)
        while not searched.done():
            service.drain()
        first = searched.result()
    assert first.status_code == 201, first.text
    again = upload(service, photo_bytes(1), headers=wait)
    assert (again.status_code, again.headers[REPLAYED]) == (202, "true")
    assert again.json()["job_id"] == first.json()["job_id"]


def test_a_refusal_is_not_stored_and_the_call_is_checked_again(
    service: Service, catalog: Catalog, store: FolderStore
) -> None:
    broken = b"\xff\xd8\xff" + bytes(5000)
    for _ in range(2):
        problem(upload(service, broken), 422, "undecodable_photo")
    assert originals(store) == 0
    assert call_map(service, headers=keyed("map")).status_code == 201
    problem(call_map(service, headers=keyed("again")), 409, "map_exists")
    assert count(catalog, StoredResponse) == 1
    service.json("DELETE", "/maps/city")
    assert call_map(service, headers=keyed("again")).status_code == 201


def test_an_invalid_body_stores_no_key(service: Service, catalog: Catalog) -> None:
    field_refused(service("POST", "/maps", json={"name": "a/b"}, headers=keyed()), "name")
    assert count(catalog, StoredResponse) == 0
    assert call_map(service, headers=keyed()).status_code == 201


def test_a_server_error_is_not_stored_under_the_key(
    service: Service, catalog: Catalog, store: FolderStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    def away(*_: object) -> None:
        raise Unavailable("object_store_unavailable", "Away.")

    with monkeypatch.context() as broken:
        broken.setattr("shared.ingest.validation.read_photo_header", away)
        problem(upload(service, photo_bytes(1)), 503, "object_store_unavailable")
        broken.setattr(model_changes, "has_live_photo", away)
        problem(call_fit(service, headers=keyed("fit")), 503, "object_store_unavailable")
    assert count(catalog, StoredResponse) == 0
    assert upload(service, photo_bytes(1)).status_code == 202
    assert call_fit(service, headers=keyed("fit")).status_code == 202
    assert (count(catalog, Photo), originals(store)) == (1, 1)


@pytest.mark.parametrize("make", [call_upload, call_evaluation, call_map], ids=lambda f: f.__name__)
@pytest.mark.databases("sqlite", "postgresql")
def test_the_same_call_at_two_gateways_at_once_has_one_effect(
    catalog: Catalog,
    store: FolderStore,
    settings: Settings,
    make_worker: Callable[[], ExtractorWorker],
    service: Service,
    make: Callable[..., httpx2.Response],
) -> None:
    service.indexed(1, latitude=45, longitude=7)
    jobs, photos = count(catalog, Job), count(catalog, Photo)
    gateways = [service, Service(catalog, store, settings, make_worker)]
    answers = at_once(*(partial(make, each, headers=keyed()) for each in gateways * 4))
    assert sum(REPLAYED not in answer.headers for answer in answers) == 1
    assert len({answer.text for answer in answers}) == 1
    made = {call_upload: (1, 1), call_evaluation: (1, 0), call_map: (0, 0)}[make]
    assert (count(catalog, Job) - jobs, count(catalog, Photo) - photos) == made
    assert originals(store) == count(catalog, Photo)


def test_a_key_has_1_to_255_visible_ascii_characters_or_is_refused_by_name(
    service: Service, catalog: Catalog, store: FolderStore
) -> None:
    for key in ("", "two words", "k" * 256, "schl\xfcssel"):
        headers = {b"Idempotency-Key": key.encode("latin-1")}
        field_refused(call_map(service, headers=headers), "Idempotency-Key")
        field_refused(call_upload(service, headers=headers), "Idempotency-Key")
    assert (count(catalog, StoredResponse), originals(store)) == (0, 0)
    first = call_map(service, headers=keyed("~" * 255))
    same(first, call_map(service, headers=keyed("~" * 255)))
