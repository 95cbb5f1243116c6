"""Batches: brought in by the steward, described by the extractors, once each whatever dies."""

from __future__ import annotations

import json
import threading
from collections import Counter
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any
from uuid import UUID

import pytest
from sqlalchemy import func, select

from services.extractor.worker import ExtractorWorker
from services.gateway.routes.batches import validate_prefix
from services.steward.batches import worker as bring_in_module
from services.steward.batches import worker as worker_module
from services.steward.batches.worker import BatchWorker, resume_batches
from services.steward.tasks.delete_maps import purge_deleted_maps
from services.steward.tasks.garbage_collection import collect_job_files
from services.steward.tasks.orphans import collect_orphans
from shared.catalog.batch_items import BatchItem
from shared.catalog.maps import get_or_create_default_map
from shared.catalog.photos import Photo
from shared.catalog.session import Catalog
from shared.config.settings import Settings
from shared.errors import StorageFull, Unavailable, Unprocessable
from shared.ingest import store_photo as store_photo_module
from shared.ingest import validation as incoming_module
from shared.jobs import InProcessWakeups, Job, JobKind, JobState, reclaim_expired_leases
from shared.storage import FolderStore, ObjectStore, OwnedStore
from shared.storage.keys import ARCHIVES, TRASH
from shared.storage.s3 import S3Store
from tests.integration.in_process_api import Service
from tests.support.archives import PACKED, tar_of, zip_of
from tests.support.catalog_rows import end_pauses, expire_lease, read_job
from tests.support.photos import photo_bytes
from tests.support.problems import problem
from tests.support.servers import S3Server

# tests/e2e/test_batches.py does the same on SQLite.
pytestmark = pytest.mark.parametrize("catalog", ["postgresql"], indirect=True)

ROUNDS = 60


class Batches:
    """A service with the steward's batches."""

    def __init__(self, service: Service, settings: Settings) -> None:
        self.service, self.settings = service, settings
        self.catalog, self.store = service.catalog, service.store
        self.worker = self.new_worker()

    def new_worker(self, **changed: Any) -> BatchWorker:
        """As after a restart, with other settings if need be."""
        settings = self.settings.model_copy(update=changed)
        return BatchWorker(self.catalog, self.store, InProcessWakeups(), settings, "steward")

    def start(self, *files: tuple[str, bytes], **parts: Any) -> UUID:
        """`POST /upload/batch` with these files, and `archive` or `manifest`; its job."""
        sent: list[tuple[str, Any]] = [("file", file) for file in files]
        if "archive" in parts:
            sent.append(("archive", ("photos", parts["archive"])))
        if "manifest" in parts:
            sent.append(("manifest", ("manifest.jsonl", parts["manifest"])))
        if "prefix" in parts:
            sent.append(("prefix", (None, parts["prefix"])))
        started = self.service.json("POST", "/upload/batch", 202, files=sent)
        return UUID(started["job_id"])

    def work(self, worker: BatchWorker | None = None) -> bool:
        """The next slice of a batch, without pauses."""
        end_pauses(self.catalog)
        return (worker or self.worker).run_next(threading.Event())

    def finish(self, job_id: UUID, worker: BatchWorker | None = None) -> dict[str, Any]:
        """Slices and drains until the batch has ended; the job as the API tells it."""
        for _ in range(ROUNDS):
            self.work(worker)
            self.service.drain()
            job = self.job(job_id)
            if job["state"] in ("succeeded", "failed", "cancelled"):
                return job
        raise AssertionError(f"the batch did not end: {job}")

    def job(self, job_id: UUID) -> dict[str, Any]:
        job: dict[str, Any] = self.service.json("GET", f"/jobs/{job_id}")
        return job

    def items(self, job_id: UUID, **params: Any) -> list[dict[str, Any]]:
        found: list[dict[str, Any]] = self.service.json(
            "GET", f"/jobs/{job_id}/items", params={"limit": 1000, **params}
        )["items"]
        return found

    def states(self, job_id: UUID) -> list[str]:
        return [item["state"] for item in self.items(job_id)]

    def photos(self) -> list[Photo]:
        with self.catalog.read() as session:
            return list(session.scalars(select(Photo).order_by(Photo.filename)))

    def keys(self, prefix: str = "") -> set[str]:
        return {
            info.key for info in self.store.list(prefix) if prefix or not info.key.startswith(TRASH)
        }


@pytest.fixture
def batches(service: Service, settings: Settings) -> Batches:
    return Batches(service, settings)


def counts(job: dict[str, Any]) -> tuple[int, int, int]:
    progress = job["progress"]
    return progress["done"], progress["total"], progress["failed"]


def codes(items: list[dict[str, Any]]) -> list[str | None]:
    return [item["error"] and item["error"]["code"] for item in items]


def files(*numbers: int) -> list[tuple[str, bytes]]:
    return [(f"{number}.jpg", photo_bytes(number)) for number in numbers]


def lines(*objects: dict[str, Any]) -> bytes:
    return b"".join(json.dumps(one).encode() + b"\n" for one in objects)


# --- a prefix ----------------------------------------------------------------------------------


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


@pytest.mark.parametrize(
    "prefix", ["originals/", "importsx/", "imports/../originals", "", "s3://elsewhere/imports/a"]
)
def test_a_prefix_that_was_not_given_free_is_refused(batches: Batches, prefix: str) -> None:
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
    job = batches.finish(batches.start(prefix="imports"), batches.new_worker(max_batch_photos=2))
    assert (job["state"], job["error"]["code"]) == ("failed", "too_many_photos")
    assert batches.photos() == []


# --- three forms -------------------------------------------------------------------------------


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


@pytest.mark.parametrize("packed", PACKED.values(), ids=PACKED.keys())
def test_an_archive_comes_in_with_its_table_and_goes(
    batches: Batches, packed: Callable[[Any], bytes]
) -> None:
    members = {
        "city/photos.csv": b'filename,latitude,longitude,tags\nin/2.jpg,45.5,7.25,"a,b"\n',
        "city/1.jpg": photo_bytes(1),
        "city/in/2.jpg": photo_bytes(2),
        "city/readme.txt": b"not a photo",
        "city/@0396544.00@4991543.00@32@T@45.0691@7.6931@@@@@@@@@.jpg": photo_bytes(3),
    }
    job_id = batches.start(archive=packed(members))
    assert len(batches.keys("archives/")) == 1
    job = batches.finish(job_id)
    assert job["state"] == "succeeded", job
    assert job["result"]["ignored"] == 1
    assert counts(job) == (3, 3, 0)
    one, two, named = batches.photos()
    assert (two.filename, two.latitude, two.longitude, two.tags) == (
        "2.jpg",
        45.5,
        7.25,
        ["a", "b"],
    )
    assert (one.filename, one.latitude) == ("1.jpg", None)
    assert named.latitude == 45.0691
    assert batches.store.get(two.object_key) == photo_bytes(2)
    assert [item["line"] for item in batches.items(job_id)] == [None, 2, None]
    collect_job_files(batches.catalog, batches.store, ARCHIVES, JobKind.BATCH)
    assert batches.keys("archives/") == set()


def test_objects_of_the_store_are_copied_and_stay(batches: Batches) -> None:
    for number in (1, 2):
        batches.store.put(f"imports/day 1/{number}.jpg", photo_bytes(number))
    manifest = lines(
        {"key": "imports/day 1/1.jpg", "latitude": 45.5, "longitude": 7},
        {"key": "imports/day 1/2.jpg"},
        {"key": "imports/nothing.jpg"},
    )
    for send in (
        {"content": manifest, "headers": {"Content-Type": "application/x-ndjson"}},
        {"files": {"manifest": ("m.jsonl", manifest)}},
    ):
        started = batches.service.json("POST", "/upload/batch", 202, **send)
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


@pytest.mark.parametrize(
    "key", ["originals/1", "chunks/a.npy", "imports/../originals/1", "imports/", "imports", "/etc"]
)
def test_only_keys_that_the_operator_has_given_free_are_read(batches: Batches, key: str) -> None:
    manifest = lines({"key": "imports/ok.jpg"}, {"key": key})
    answer = batches.service(
        "POST",
        "/upload/batch",
        content=manifest,
        headers={"Content-Type": "application/x-ndjson"},
    )
    body = problem(answer, 400, "bad_manifest")
    assert [error["line"] for error in body["errors"]] == [2]
    assert "IMPORT_PREFIX" in body["detail"]


# --- what is refused as a whole ----------------------------------------------------------------


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
        ([("archive", ("a", zip_of({}))), ("file", ("a.jpg", b"x"))], 400, "several_sources"),
        ([("archive", ("a", zip_of({}))), ("archive", ("b", zip_of({})))], 400, "several_sources"),
        ([("archive", ("a.zip", b"no archive" * 100))], 415, "unsupported_archive"),
        ([("archive", ("a.zip", b"short"))], 415, "unsupported_archive"),
        ([("archive", ("a.zip", b""))], 400, "empty_file"),
        ([("archive", (None, b"text"))], 400, "no_file"),
        ([("manifest", ("m", b"\n\n"))], 422, "no_photos"),
        (
            [("file", ("a.jpg", b"x")), ("manifest", ("m", b'{"file": "b.jpg"}'))],
            400,
            "bad_manifest",
        ),
    ],
)
def test_a_body_that_is_no_batch_is_refused_and_leaves_nothing(
    batches: Batches, parts: list[Any], status: int, code: str
) -> None:
    # Without a file a form would be sent as something else.
    sent = parts or [("nothing", (None, b""))]
    answer = batches.service("POST", "/upload/batch", files=sent)
    problem(answer, *((422, "invalid_field") if not parts else (status, code)))
    assert batches.keys() == set()


def test_limits_of_a_batch_are_said_and_leave_nothing(
    catalog: Catalog,
    store: FolderStore,
    settings: Settings,
    make_worker: Callable[[], ExtractorWorker],
) -> None:
    small = settings.model_copy(update={"max_archive_size": 3000, "max_batch_photos": 2})
    with catalog.write() as session:
        get_or_create_default_map(session, settings.extractor)
    service = Service(catalog, store, small, make_worker)

    def refused(**sent: Any) -> str:
        answer = service("POST", "/upload/batch", **sent)
        assert list(store.list("")) == []
        return str(problem(answer, 413, answer.json()["code"])["code"])

    archive = zip_of({"a.jpg": bytes(range(256)) * 20}, 0)
    assert refused(files={"archive": ("a.zip", archive)}) == "batch_too_large"
    large = [("file", (f"{n}.jpg", b"\xff\xd8\xff" + bytes(2000))) for n in range(2)]
    assert refused(files=large) == "batch_too_large"
    tiny = [("file", (f"{n}.jpg", b"\xff\xd8\xff")) for n in range(3)]
    assert refused(files=tiny) == "too_many_photos"
    keys = lines(*({"key": f"imports/{n}.jpg"} for n in range(3)))
    headers = {"Content-Type": "application/x-ndjson"}
    assert refused(content=keys, headers=headers) == "too_many_photos"
    problem(service("POST", "/upload/batch?map=nope", content=keys[:20]), 400, "no_file")


def test_an_archive_for_a_map_that_is_not_there_leaves_nothing(batches: Batches) -> None:
    sent = {"archive": ("a.zip", zip_of({"1.jpg": photo_bytes(1)}))}
    answer = batches.service("POST", "/upload/batch", params={"map": "nope"}, files=sent)
    problem(answer, 404, "map_not_found")
    assert batches.keys() == set()


@pytest.mark.parametrize(
    ("archive", "code"),
    [
        (zip_of({"readme.txt": b"hello", "folder/": b""}), "no_photos"),
        (zip_of({"a.jpg": photo_bytes(1)})[:-30], "damaged_archive"),
        (tar_of({"a.jpg": photo_bytes(1)})[:1000], "damaged_archive"),
        (zip_of({"a.jpg": b"x", "photos.csv": b"latitude,longitude\n1,2\n"}), "bad_table"),
        (zip_of({"a.jpg": b"x", "photos.csv": b"file,place\nb.jpg,hall\n"}), "bad_table"),
        (zip_of({"a.jpg": b"x", "manifest.jsonl": b'{"file": "a.jpg"}\noops'}), "bad_manifest"),
        (
            zip_of({"a.jpg": b"x", "manifest.jsonl": b"", "photos.csv": b"file\n"}),
            "several_manifests",
        ),
    ],
)
def test_an_archive_that_makes_no_sense_fails_and_brings_in_nothing(
    batches: Batches, archive: bytes, code: str
) -> None:
    job_id = batches.start(archive=archive)
    job = batches.finish(job_id)
    assert (job["state"], job["error"]["code"]) == ("failed", code)
    assert batches.items(job_id) == []
    assert batches.photos() == []
    answer = batches.service("POST", f"/jobs/{job_id}/retry")
    assert "Upload them again" in problem(answer, 409, "job_not_retryable")["detail"]
    collect_job_files(batches.catalog, batches.store, ARCHIVES, JobKind.BATCH)
    assert batches.keys("archives/") == set()
    assert not batches.work()


# --- single items ------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_each_bad_member_has_its_reason_and_the_others_come_in(
    batches: Batches, monkeypatch: pytest.MonkeyPatch
) -> None:
    members = [
        ("good.jpg", photo_bytes(1)),
        ("text.jpg", b"not a photo at all, by its content"),
        ("cut.jpg", b"\xff\xd8\xff" + bytes(1000)),
        ("inner.zip", zip_of({"a.jpg": photo_bytes(9)})),
        ("far.jpg", photo_bytes(2)),
        ("twice.jpg", photo_bytes(3)),
        ("twice.jpg", photo_bytes(4)),
        ("../../up.jpg", photo_bytes(5)),
        ("empty.jpg", b""),
        ("large.jpg", b"\xff\xd8\xff" + bytes(300_000)),
        ("same.jpg", photo_bytes(1)),
        ("__MACOSX/._good.jpg", b"resources"),
        (".hidden.jpg", photo_bytes(6)),
        ("folder.jpg/", b""),
        ("photos.csv", b"file,latitude,longitude\nfar.jpg,95,7\ntwice.jpg,1,2\n"),
    ]
    job_id = batches.start(archive=zip_of(members))
    worker = batches.new_worker(max_file_size=100_000)
    job = batches.finish(job_id, worker)
    assert job["state"] == "succeeded"
    assert counts(job) == (3, 11, 8)
    assert job["result"]["ignored"] == 3
    items = batches.items(job_id)
    assert codes(items) == [
        None,
        "unsupported_photo",
        "undecodable_photo",
        "nested_archive",
        "invalid_field",
        "ambiguous_name",
        "ambiguous_name",
        None,
        "empty_file",
        "file_too_large",
        None,
    ]
    assert items[4]["error"]["line"] == 2
    assert items[4]["error"]["detail"].startswith("Line 2: latitude: ")
    assert items[10]["already_there"]
    assert items[10]["file_id"] == items[0]["file_id"]
    assert [photo.filename for photo in batches.photos()] == ["good.jpg", "up.jpg"]
    assert len(batches.keys("originals/")) == 2, "what is refused leaves no bytes"
    assert codes(batches.items(job_id, state="failed")) == [c for c in codes(items) if c]


def test_uploaded_files_are_refused_one_by_one_and_leave_no_bytes(batches: Batches) -> None:
    job_id = batches.start(
        ("text.jpg", b"no photo"),
        *files(1),
        ("cut.jpg", b"\xff\xd8\xff" + bytes(1000)),
        ("empty.jpg", b""),
        *files(1),
    )
    job = batches.finish(job_id)
    assert counts(job) == (2, 5, 3)
    assert codes(batches.items(job_id)) == [
        "unsupported_photo",
        None,
        "undecodable_photo",
        "empty_file",
        None,
    ]
    assert len(batches.keys("originals/")) == 1


def test_items_come_in_pages(batches: Batches) -> None:
    job_id = batches.start(*files(*range(5)))
    found: list[int] = []
    cursor: str | None = None
    while True:
        page = batches.service.json(
            "GET",
            f"/jobs/{job_id}/items",
            params={"limit": 2, **({"cursor": cursor} if cursor else {})},
        )
        found += [item["number"] for item in page["items"]]
        cursor = page["next_cursor"]
        if cursor is None:
            break
    assert found == [1, 2, 3, 4, 5]
    for wrong in ("x", "-1", "9" * 30):
        answer = batches.service("GET", f"/jobs/{job_id}/items", params={"cursor": wrong})
        problem(answer, 422, "invalid_field")


def test_other_jobs_have_no_items(batches: Batches) -> None:
    job_id = batches.service.upload(photo_bytes(1))["job_id"]
    problem(batches.service("GET", f"/jobs/{job_id}/items"), 409, "no_items")
    problem(batches.service("GET", f"/jobs/{UUID(int=1)}/items"), 404, "job_not_found")


def test_the_same_bytes_of_which_something_else_is_said_are_refused(batches: Batches) -> None:
    batches.service.indexed(1, place="hall")
    manifest = lines({"filename": "1.jpg", "place": "yard"})
    job_id = batches.start(*files(1), manifest=manifest)
    batches.finish(job_id)
    assert codes(batches.items(job_id)) == ["photo_differs"]
    assert len(batches.keys("originals/")) == 1


def test_a_photo_that_can_not_be_decoded_fails_its_item(batches: Batches) -> None:
    whole = photo_bytes(1)
    header = whole[: whole.index(b"\xff\xda")] + bytes(2)
    job_id = batches.start(("torn.jpg", header), *files(2))
    job = batches.finish(job_id)
    assert (job["state"], counts(job)) == ("succeeded", (1, 2, 1))
    [failed] = batches.items(job_id, state="failed")
    assert failed["error"]["code"] == "undecodable_photo"
    assert failed["file_id"]


# --- pace, cancel, retry -----------------------------------------------------------------------


def queued_photos(catalog: Catalog) -> int:
    with catalog.read() as session:
        return (
            session.scalar(
                select(func.count())
                .select_from(Job)
                .where(Job.kind == JobKind.INDEX, Job.state == JobState.QUEUED)
            )
            or 0
        )


def test_a_batch_brings_in_no_more_than_the_extractors_have_room_for(batches: Batches) -> None:
    job_id = batches.start(archive=zip_of(dict(files(*range(10)))))
    worker = batches.new_worker(batch_ahead_photos=4)
    for _ in range(3):
        batches.work(worker)
    assert queued_photos(batches.catalog) == 4
    assert Counter(batches.states(job_id)) == {"running": 4, "queued": 6}
    batches.service.drain()
    batches.work(worker)
    assert Counter(batches.states(job_id)) == {"succeeded": 4, "running": 4, "queued": 2}
    assert counts(batches.finish(job_id, worker)) == (10, 10, 0)


def test_an_upload_goes_before_the_photos_of_a_batch(batches: Batches) -> None:
    batches.start(*files(*range(4)))
    batches.work()
    upload = batches.service.upload(photo_bytes(9))
    with batches.catalog.read() as session:
        first = session.scalar(select(Job.id).order_by(Job.priority.desc(), Job.id).limit(1))
    assert str(first) == upload["job_id"]


def test_batches_take_turns(batches: Batches, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker_module, "SLICE_SECONDS", 0.0)
    jobs = [batches.start(*files(*range(begin, begin + 3))) for begin in (0, 10)]
    monkeypatch.setattr(worker_module, "YIELD_SECONDS", 60.0)
    for _ in range(2):
        assert batches.worker.run_next(threading.Event())
    assert [batches.job(job_id)["state"] for job_id in jobs] == ["running", "running"]


def test_cancelling_ends_what_has_not_ended(batches: Batches) -> None:
    batches.service.indexed(0)
    job_id = batches.start(archive=zip_of(dict(files(*range(8)))))
    worker = batches.new_worker(batch_ahead_photos=3)
    batches.work(worker)
    batches.service.drain()
    batches.work(worker)
    cancelled = batches.service.json("POST", f"/jobs/{job_id}/cancel")
    assert cancelled["state"] == "cancelled"
    states = Counter(batches.states(job_id))
    assert states["succeeded"] == 4, "the one that was there, and three described"
    assert set(states) == {"succeeded", "cancelled"}
    assert queued_photos(batches.catalog) == 0
    assert not batches.work()
    collect_job_files(batches.catalog, batches.store, ARCHIVES, JobKind.BATCH)
    assert batches.keys("archives/") == set()
    problem(batches.service("POST", f"/jobs/{job_id}/cancel"), 409, "job_finished")


def test_retry_queues_the_failed_items_again_whose_bytes_are_there(batches: Batches) -> None:
    batches.store.put("imports/1.jpg", photo_bytes(1))
    manifest = lines({"key": "imports/1.jpg"}, {"key": "imports/2.jpg"})
    started = batches.service.json(
        "POST",
        "/upload/batch",
        202,
        content=manifest,
        headers={"Content-Type": "application/x-ndjson"},
    )
    job_id = UUID(started["job_id"])
    problem(batches.service("POST", f"/jobs/{job_id}/retry"), 409, "job_not_retryable")
    assert counts(batches.finish(job_id)) == (1, 2, 1)
    batches.store.put("imports/2.jpg", photo_bytes(2))
    again = batches.service.json("POST", f"/jobs/{job_id}/retry")
    assert again["state"] == "queued"
    assert Counter(batches.states(job_id)) == {"succeeded": 1, "queued": 1}
    assert counts(batches.finish(job_id)) == (2, 2, 0)
    problem(batches.service("POST", f"/jobs/{job_id}/retry"), 409, "job_not_retryable")


def test_retry_describes_the_photos_of_a_cancelled_batch(batches: Batches) -> None:
    job_id = batches.start(archive=zip_of(dict(files(*range(6)))))
    batches.work(batches.new_worker(batch_ahead_photos=4))
    batches.service.json("POST", f"/jobs/{job_id}/cancel")
    assert set(batches.states(job_id)) == {"cancelled"}
    batches.service.json("POST", f"/jobs/{job_id}/retry")
    job = batches.finish(job_id)
    assert (job["state"], job["result"]["succeeded"], job["result"]["cancelled"]) == (
        "succeeded",
        4,
        2,
    )


def test_a_photo_that_is_deleted_meanwhile_ends_its_item(batches: Batches) -> None:
    job_id = batches.start(*files(1, 2))
    batches.work()
    item = batches.items(job_id)[0]
    batches.service.json("DELETE", f"/uploads/{item['file_id']}")
    job = batches.finish(job_id)
    assert (job["state"], batches.states(job_id)) == ("succeeded", ["cancelled", "succeeded"])
    assert counts(job) == (1, 2, 0)


def test_a_map_that_is_deleted_takes_its_batch_along(batches: Batches) -> None:
    batches.start(archive=zip_of(dict(files(*range(6)))))
    batches.start(*files(7, 8))
    batches.work(batches.new_worker(batch_ahead_photos=3))
    batches.service.json("DELETE", "/maps/default")
    for _ in range(ROUNDS):
        purge_deleted_maps(batches.catalog, batches.store)
    assert batches.keys("originals/") | batches.keys("archives/") == set()
    with batches.catalog.read() as session:
        assert session.scalar(select(func.count()).select_from(BatchItem)) == 0


def test_a_batch_waits_with_its_photos_for_a_vocabulary(batches: Batches, service: Service) -> None:
    service.json("POST", "/maps", 201, json={"name": "vlad", "extractor": "test-tiny-vlad"})
    sent = [("file", file) for file in files(1, 2)]
    started = service.json("POST", "/upload/batch", 202, params={"map": "vlad"}, files=sent)
    for _ in range(3):
        batches.work()
        service.drain()
    path = f"/jobs/{started['job_id']}"
    job = service.json("GET", path, params={"map": "vlad"})
    assert (job["state"], job["waiting_for"]) == ("running", "vocabulary")
    assert not batches.work()
    service.json("POST", "/vocabularies", 202, params={"map": "vlad"}, json={"clusters": 2})
    for _ in range(6):
        service.drain()
        batches.work()
    job = service.json("GET", path, params={"map": "vlad"})
    assert (job["state"], counts(job)) == ("succeeded", (2, 2, 0))


# --- killed anywhere ---------------------------------------------------------------------------


class Killed(BaseException):
    pass


def restart(batches: Batches, job_id: UUID) -> BatchWorker:
    """Another steward, once the dead one's lease is over."""
    expire_lease(batches.catalog, job_id)
    with batches.catalog.write() as session:
        assert reclaim_expired_leases(session, max_attempts=3) == 1
    return batches.new_worker()


def assert_each_is_there_once(batches: Batches, job_id: UUID, photos: int) -> None:
    job = batches.finish(job_id)
    assert (job["state"], counts(job)) == ("succeeded", (photos, photos, 0))
    assert len(batches.photos()) == photos
    with batches.catalog.read() as session:
        jobs = session.scalars(select(Job).where(Job.kind == JobKind.INDEX)).all()
    assert len(jobs) == photos
    stored = {photo.object_key for photo in batches.photos()}
    assert stored <= batches.keys("originals/")
    collect_orphans(batches.catalog, batches.store, age_seconds=-60)
    assert batches.keys("originals/") == stored


@pytest.mark.parametrize("step", ["writer", "read_range", "open", "head", "delete"])
@pytest.mark.parametrize("source", ["zip", "tar.gz", "files", "keys"])
def test_a_steward_killed_at_any_step_leaves_each_photo_once(
    batches: Batches, monkeypatch: pytest.MonkeyPatch, source: str, step: str
) -> None:
    """Each life ends at its nth step of a kind with the object store; the next life is longer."""
    photos = files(*range(6))
    if source == "files":
        job_id = batches.start(*photos)
    elif source == "keys":
        for name, data in photos:
            batches.store.put(f"imports/{name}", data)
        job_id = batches.start(manifest=lines(*({"key": f"imports/{n}"} for n, _ in photos)))
    else:
        job_id = batches.start(archive=PACKED[source](photos))
    real: Any = getattr(FolderStore, step)
    for life in (1, 3, 7):  # an archive that kills three while it is looked through is given up
        left = [life]

        def die(self: FolderStore, *arguments: Any, left: list[int] = left) -> Any:
            left[0] -= 1
            if left[0] == 0:
                raise Killed
            return real(self, *arguments)

        monkeypatch.setattr(FolderStore, step, die)
        try:
            batches.work()
        except Killed:
            monkeypatch.setattr(FolderStore, step, real)
            batches.worker = restart(batches, job_id)
        monkeypatch.setattr(FolderStore, step, real)
    assert_each_is_there_once(batches, job_id, len(photos))


def test_a_steward_killed_in_each_commit_leaves_each_photo_once(
    batches: Batches, monkeypatch: pytest.MonkeyPatch
) -> None:
    job_id = batches.start(archive=zip_of(files(*range(5))))
    real = store_photo_module.insert_photo

    def put_then_die(*arguments: Any) -> Any:
        real(*arguments)
        raise Killed

    for life in range(2):
        monkeypatch.setattr(bring_in_module, "insert_photo", put_then_die)
        with pytest.raises(Killed):
            batches.work()
        monkeypatch.setattr(bring_in_module, "insert_photo", real)
        assert batches.photos() == [], life
        batches.worker = restart(batches, job_id)
    assert len(batches.keys("originals/")) == 2, "orphans of the two lives"
    batches.work(batches.new_worker(max_attempts=100))
    assert_each_is_there_once(batches, job_id, 5)


def test_a_steward_whose_lease_was_taken_over_commits_nothing(
    batches: Batches, monkeypatch: pytest.MonkeyPatch
) -> None:
    job_id = batches.start(archive=zip_of(files(*range(4))))
    real: Any = FolderStore.writer
    slow = batches.worker

    def be_slow(self: FolderStore, key: str) -> Any:
        monkeypatch.setattr(FolderStore, "writer", real)
        other = restart(batches, job_id)
        assert batches.work(other)
        return real(self, key)

    monkeypatch.setattr(FolderStore, "writer", be_slow)
    assert batches.work(slow)
    assert_each_is_there_once(batches, job_id, 4)


def test_an_item_that_kills_its_stewards_is_given_up_and_the_others_come_in(
    batches: Batches, monkeypatch: pytest.MonkeyPatch
) -> None:
    job_id = batches.start(archive=zip_of(files(*range(4))))
    real = incoming_module.validate_photo

    def die_of_one(store: ObjectStore, received: Any, *rest: Any, **said: Any) -> Any:
        if received.filename == "2.jpg":
            raise Killed
        return real(store, received, *rest, **said)

    monkeypatch.setattr(bring_in_module, "validate_photo", die_of_one)
    for _ in range(3):
        with pytest.raises(Killed):
            batches.work()
        batches.worker = restart(batches, job_id)
    job = batches.finish(job_id)
    assert (job["state"], counts(job)) == ("succeeded", (3, 4, 1))
    assert codes(batches.items(job_id)) == [None, None, "worker_fell", None]


def test_a_batch_pauses_while_the_store_is_away(
    batches: Batches, monkeypatch: pytest.MonkeyPatch
) -> None:
    job_id = batches.start(archive=zip_of(files(1, 2)))
    real: Any = FolderStore.writer

    def away(self: FolderStore, key: str) -> Any:
        raise Unavailable("object_store_unavailable", "gone for lunch")

    monkeypatch.setattr(FolderStore, "writer", away)
    assert batches.work()
    job = read_job(batches.catalog, job_id)
    assert (job.state, job.attempts) == (JobState.RUNNING, 0)
    assert job.run_after is not None
    monkeypatch.setattr(FolderStore, "writer", real)
    assert_each_is_there_once(batches, job_id, 2)


def test_a_batch_waits_while_the_disk_is_full_and_goes_on_by_itself(
    batches: Batches, monkeypatch: pytest.MonkeyPatch
) -> None:
    job_id = batches.start(archive=zip_of(files(1, 2)))
    free = SimpleNamespace(free=batches.settings.min_free_bytes - 1)
    monkeypatch.setattr("shared.config.disk_space.shutil.disk_usage", lambda folder: free)
    assert batches.work()
    for _ in range(2):
        resume_batches(batches.catalog, batches.settings)
        assert not batches.work(), "nothing is taken while it waits"
    job = batches.job(job_id)
    assert (job["state"], job["waiting_for"]) == ("running", "disk_space")
    assert (job["stage"], counts(job), batches.photos()) == ("store", (0, 2, 0), [])
    free.free += 1
    resume_batches(batches.catalog, batches.settings)
    assert_each_is_there_once(batches, job_id, 2)


def test_a_batch_waits_while_the_store_has_no_room_and_tries_again(
    batches: Batches, monkeypatch: pytest.MonkeyPatch
) -> None:
    job_id = batches.start(archive=zip_of(files(1, 2)))
    real: Any = FolderStore.writer

    def full(self: FolderStore, key: str) -> Any:
        raise StorageFull("object_store_full", "no room")

    monkeypatch.setattr(FolderStore, "writer", full)
    assert batches.work()
    assert batches.job(job_id)["waiting_for"] == "disk_space"
    monkeypatch.setattr(FolderStore, "writer", real)
    resume_batches(batches.catalog, batches.settings)
    assert_each_is_there_once(batches, job_id, 2)


def test_an_archive_that_was_removed_fails_its_batch(batches: Batches) -> None:
    job_id = batches.start(archive=zip_of(files(1)))
    [key] = batches.keys("archives/")
    batches.store.delete(key)
    job = batches.finish(job_id)
    assert (job["state"], job["error"]["code"]) == ("failed", "archive_gone")


def test_bytes_that_wait_in_a_batch_are_no_orphans(batches: Batches) -> None:
    job_id = batches.start(*files(1, 2))
    archive_id = batches.start(archive=zip_of(files(3)))
    collect_job_files(batches.catalog, batches.store, ARCHIVES, JobKind.BATCH)
    collect_orphans(batches.catalog, batches.store, age_seconds=-60)
    assert counts(batches.finish(job_id)) == (2, 2, 0)
    assert counts(batches.finish(archive_id)) == (1, 1, 0)
    batches.store.put(f"archives/{UUID(int=7)}", b"of a gateway that was killed")
    collect_job_files(batches.catalog, batches.store, ARCHIVES, JobKind.BATCH)
    assert f"archives/{UUID(int=7)}" in batches.keys("archives/")
    collect_orphans(batches.catalog, batches.store, age_seconds=-60)
    assert batches.keys("archives/") == set()


def test_a_forgotten_batch_takes_its_items_along(batches: Batches) -> None:
    job_id = batches.start(*files(1))
    batches.finish(job_id)
    with batches.catalog.write() as session:
        session.delete(session.get_one(Job, job_id))
    with batches.catalog.read() as session:
        assert session.scalar(select(func.count()).select_from(BatchItem)) == 0
        assert session.scalar(select(func.count()).select_from(Photo)) == 1


# --- on a bucket -------------------------------------------------------------------------------


@pytest.fixture
def on_s3(
    catalog: Catalog,
    s3: S3Server,
    settings: Settings,
    make_worker: Callable[[], ExtractorWorker],
) -> Batches:
    """As `batches`, with the objects in a bucket. No photo is described: extractors have others."""
    with catalog.write() as session:
        get_or_create_default_map(session, settings.extractor)
    store: OwnedStore = S3Store(s3.new_bucket())
    return Batches(Service(catalog, store, settings, make_worker), settings)


@pytest.mark.parametrize("source", ["zip", "tar", "tar.gz", "files", "keys"])
def test_every_source_is_brought_in_on_a_bucket_across_a_kill(
    on_s3: Batches, monkeypatch: pytest.MonkeyPatch, source: str
) -> None:
    photos = files(*range(5))
    if source == "files":
        job_id = on_s3.start(*photos)
    elif source == "keys":
        for name, data in photos:
            on_s3.store.put(f"imports/{name}", data)
        job_id = on_s3.start(manifest=lines(*({"key": f"imports/{n}"} for n, _ in photos)))
    else:
        job_id = on_s3.start(archive=PACKED[source](photos))
    real = incoming_module.validate_photo
    left = [3]

    def die_at_the_third(*arguments: Any) -> Any:
        left[0] -= 1
        if left[0] == 0:
            raise Killed
        return real(*arguments)

    monkeypatch.setattr(bring_in_module, "validate_photo", die_at_the_third)
    with pytest.raises(Killed):
        on_s3.work()
    on_s3.worker = restart(on_s3, job_id)
    on_s3.work()
    assert on_s3.states(job_id) == ["running"] * 5
    stored = on_s3.photos()
    assert [photo.filename for photo in stored] == [name for name, _ in photos]
    for photo, (_, data) in zip(stored, photos, strict=True):
        assert on_s3.store.get(photo.object_key) == data
