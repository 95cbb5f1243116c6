"""Batches from a prefix, files and keys, and batches that are rejected as a whole."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any
from uuid import UUID

import pytest

from services.extractor.worker import ExtractorWorker
from services.gateway.routes.batches import validate_prefix
from shared.catalog.database.session import Catalog
from shared.catalog.maps import get_or_create_default_map
from shared.config.settings import Settings
from shared.errors import Unprocessable
from shared.storage import FolderStore
from tests.integration.in_process_api import Service
from tests.integration.steward.batches import Batches, codes, counts, files, lines
from tests.support.archives import tar_of, zip_of
from tests.support.photos import photo_bytes
from tests.support.problems import problem


def test_every_photo_below_a_prefix_comes_in_and_again_nothing_twice(batches: Batches) -> None:
    names = ("monday/1.jpg", "monday/north/2.JPG", "tuesday/3.jpg")
    for number, name in enumerate(names, start=1):
        batches.store.put(f"imports/{name}", photo_bytes(number))
    batches.store.put("imports/monday/notes.txt", b"no photo")
    batches.store.put("imports/monday/4.heic", b"nor this")
    for already_there in (False, True):
        job_id = batches.start(prefix="imports/monday/")
        job = batches.finish(job_id)
        items = batches.items(job_id)
        assert [item["name"] for item in items] == [
            "imports/monday/1.jpg",
            "imports/monday/4.heic",
            "imports/monday/north/2.JPG",
        ]
        assert codes(items) == [None, "unsupported_photo", None]
        assert [item["already_there"] for item in items] == [already_there, False, already_there]
        assert (job["result"]["ignored"], counts(job)) == (1, (2, 3, 1))
    assert len(batches.photos()) == 2
    assert len(batches.keys("imports/")) == 5, "they are copied; the originals stay"


@pytest.mark.parametrize("prefix", ["importsx/", "imports/../originals", ""])
def test_a_prefix_outside_imports_is_refused(batches: Batches, prefix: str) -> None:
    answer = batches.service("POST", "/upload/batch", files={"prefix": (None, prefix)})
    problem(answer, 422, "invalid_field")


@pytest.mark.usefixtures("catalog")
def test_a_prefix_may_be_written_as_an_address_in_the_servers_own_bucket(
    settings: Settings,
) -> None:
    own = settings.model_copy(update={"s3_endpoint": "http://s3:9000", "s3_bucket": "city"})
    assert validate_prefix("s3://city/imports/monday", own) == "imports/monday/"
    assert validate_prefix("imports/monday/", own) == "imports/monday/"
    for wrong in ("s3://other/imports/monday", "s3://city/originals", "s3://city", "s3://"):
        with pytest.raises(Unprocessable) as caught:
            validate_prefix(wrong, own)
        assert caught.value.code == "invalid_field"


def test_a_prefix_without_photos_fails_and_says_so(batches: Batches) -> None:
    job = batches.finish(batches.start(prefix="imports/nothing"))
    assert (job["state"], job["error"]["code"]) == ("failed", "no_photos")


def test_a_prefix_with_too_many_photos_brings_in_none(batches: Batches) -> None:
    for number in range(3):
        batches.store.put(f"imports/{number}.jpg", photo_bytes(number))
    job = batches.finish(batches.start(prefix="imports"), batches.new_worker(max_queued_jobs=4))
    assert (job["state"], job["error"]["code"]) == ("failed", "too_many_photos")
    assert batches.photos() == []


def test_files_become_searchable_photos_with_what_the_manifest_says(batches: Batches) -> None:
    manifest = lines(
        {"filename": "2.jpg", "latitude": 45.5, "longitude": 7.25, "tags": ["a", "b"]},
        {"filename": "3.jpg", "place": "hall", "metadata": {"floor": 2}},
    )
    job_id = batches.start(*files(1, 2, 3), manifest=manifest)
    assert counts(batches.job(job_id)) == (0, 3, 0)
    job = batches.finish(job_id)
    assert job["state"] == "succeeded"
    assert counts(job) == (3, 3, 0)
    assert job["result"] == {
        "photos": 3,
        "succeeded": 3,
        "failed": 0,
        "cancelled": 0,
        "already_there": 0,
        "ignored": 0,
    }
    first, second, third = batches.photos()
    assert (second.latitude, second.longitude, second.tags) == (45.5, 7.25, ["a", "b"])
    assert (third.place, third.attributes) == ("hall", {"floor": 2})
    assert (first.latitude, first.place) == (None, None)
    items = batches.items(job_id)
    assert [item["name"] for item in items] == ["1.jpg", "2.jpg", "3.jpg"]
    assert [item["line"] for item in items] == [None, 1, 2]
    assert [item["file_id"] for item in items] == [str(p.id) for p in (first, second, third)]
    stats = batches.service.json("GET", "/database/stats")
    assert stats["searchable_images"] == 3


def test_objects_of_the_store_are_copied_and_stay(batches: Batches) -> None:
    for number in (1, 2):
        batches.store.put(f"imports/day 1/{number}.jpg", photo_bytes(number))
    manifest = lines(
        {"key": "imports/day 1/1.jpg", "latitude": 45.5, "longitude": 7},
        {"key": "imports/day 1/2.jpg"},
        {"key": "imports/nothing.jpg"},
    )
    form = {"manifest": ("m.jsonl", manifest)}
    for _ in range(2):
        started = batches.service.json("POST", "/upload/batch", 202, files=form)
        job = batches.finish(UUID(started["job_id"]))
        assert job["state"] == "succeeded"
        assert counts(job) == (2, 3, 1)
        items = batches.items(UUID(started["job_id"]))
        assert codes(items) == [None, None, "object_not_found"]
        assert items[2]["error"]["line"] == 3
    assert job["result"]["already_there"] == 2
    one, _ = batches.photos()
    assert (one.filename, one.latitude) == ("1.jpg", 45.5)
    assert one.object_key.startswith("originals/")
    assert len(batches.keys("imports/")) == 2
    assert len(batches.keys("originals/")) == 2


@pytest.mark.parametrize("key", ["originals/1", "imports/../originals/1", "imports/", "imports"])
def test_only_keys_below_imports_are_read(batches: Batches, key: str) -> None:
    manifest = lines({"key": "imports/ok.jpg"}, {"key": key})
    form = {"manifest": ("m.jsonl", manifest)}
    answer = batches.service("POST", "/upload/batch", files=form)
    body = problem(answer, 400, "bad_manifest")
    assert [error["line"] for error in body["errors"]] == [2]
    assert "not below imports/" in body["detail"]


def test_bad_lines_of_a_manifest_are_named_and_leave_nothing(batches: Batches) -> None:
    manifest = (
        b'{"filename": "1.jpg", "latitude": 45, "longitude": 7}\n'
        b"not json\n\n"
        b'{"filename": "1.jpg"}\n'
        b'{"filename": "2.jpg", "colour": "red"}\n'
        b'["a list"]\n'
        b'{"latitude": 45}\n'
        b'{"filename": "2.jpg", "tags": [1]}\n'
        b'{"filename": "2.jpg", "place": "a\\u0000b"}\n'
    )
    sent = [("file", file) for file in files(1, 2)] + [("manifest", ("m", manifest))]
    body = problem(batches.service("POST", "/upload/batch", files=sent), 400, "bad_manifest")
    assert [error["line"] for error in body["errors"]] == [2, 4, 5, 6, 7, 8, 9]
    assert "line 5: colour is unknown" in body["detail"]
    assert batches.keys() == set()
    assert batches.service.json("GET", "/jobs")["jobs"] == []


@pytest.mark.parametrize(
    ("parts", "status", "code"),
    [
        ([], 400, "no_file"),
        ([("file", ("a.jpg", b"")), ("colour", (None, b"red"))], 422, "invalid_field"),
        ([("file", (None, b"text"))], 400, "no_file"),
        ([("file", ("a.jpg", b"x")), ("prefix", (None, b"imports/"))], 400, "several_sources"),
        ([("manifest", ("m", b"")), ("manifest", ("m", b""))], 400, "several_sources"),
        ([("manifest", ("m", b"\n\n"))], 422, "no_photos"),
        (
            [("file", ("a.jpg", b"x")), ("manifest", ("m", b'{"file": "b.jpg"}'))],
            400,
            "bad_manifest",
        ),
    ],
)
def test_an_invalid_batch_body_is_refused_and_stores_nothing(
    batches: Batches, parts: list[Any], status: int, code: str
) -> None:
    # Without a file a form would be sent as something else.
    sent = parts or [("nothing", (None, b""))]
    answer = batches.service("POST", "/upload/batch", files=sent)
    problem(answer, *((422, "invalid_field") if not parts else (status, code)))
    assert batches.keys() == set()


def test_limits_of_a_batch_are_reported_and_leave_nothing(
    catalog: Catalog,
    store: FolderStore,
    settings: Settings,
    make_worker: Callable[[], ExtractorWorker],
) -> None:
    small = settings.model_copy(update={"max_queued_jobs": 20})
    with catalog.write() as session:
        get_or_create_default_map(session, settings.extractor)
    service = Service(catalog, store, small, make_worker)

    def refused(**sent: Any) -> str:
        answer = service("POST", "/upload/batch", **sent)
        assert list(store.list("")) == []
        return str(problem(answer, 413, answer.json()["code"])["code"])

    tiny = [("file", (f"{n}.jpg", b"\xff\xd8\xff")) for n in range(11)]
    assert refused(files=tiny) == "too_many_photos"
    assert refused(files=tiny, headers={"Content-Length": "20000000000"}) == "batch_too_large"
    keys = lines(*({"key": f"imports/{n}.jpg"} for n in range(11)))
    assert refused(files={"manifest": ("m.jsonl", keys)}) == "too_many_photos"
    problem(service("POST", "/upload/batch?map=nope", content=keys[:20]), 400, "no_file")


def test_an_archive_is_refused_with_the_command_that_reads_it(batches: Batches) -> None:
    archive = zip_of({"1.jpg": photo_bytes(1)})
    answer = batches.service("POST", "/upload/batch", files={"archive": ("a.zip", archive)})
    assert "placewise index" in problem(answer, 422, "invalid_field")["detail"]
    for data in (archive, tar_of({"1.jpg": photo_bytes(1)}, "w:gz")):
        answer = batches.service("POST", "/upload", files={"file": ("a.zip", data)})
        assert "placewise index" in problem(answer, 415, "unsupported_photo")["detail"]
    assert batches.keys() == set()


def test_files_for_a_map_that_is_not_there_leave_nothing(batches: Batches) -> None:
    sent = [("file", file) for file in files(1)]
    answer = batches.service("POST", "/upload/batch", params={"map": "nope"}, files=sent)
    problem(answer, 404, "map_not_found")
    assert batches.keys() == set()


def test_a_batch_without_bytes_to_try_again_says_so(batches: Batches) -> None:
    job_id = batches.start(("text.jpg", b"no photo"))
    batches.finish(job_id)
    answer = batches.service("POST", f"/jobs/{job_id}/retry")
    assert "Upload them again" in problem(answer, 409, "job_not_retryable")["detail"]
