"""Items of batches: errors of single items, backpressure, cancel, retry."""

from __future__ import annotations

import threading
from collections import Counter
from uuid import UUID

import pytest
from sqlalchemy import func, select

from services.steward.batches import worker as worker_module
from services.steward.batches.worker import cancel_items_of_ended_batches
from shared.catalog.database.session import Catalog
from shared.jobs import Job, JobKind, JobState
from tests.integration.in_process_api import Service
from tests.integration.steward.batches import Batches, codes, counts, files, lines
from tests.support.photos import photo_bytes
from tests.support.problems import problem

pytestmark = pytest.mark.databases("postgresql")


def test_each_bad_object_has_its_reason_and_the_others_come_in(batches: Batches) -> None:
    job_id = batches.start_import(
        [
            ("far.jpg", photo_bytes(2)),
            ("good.jpg", photo_bytes(1)),
            ("text.jpg", b"not a photo at all, by its content"),
            ("archive.jpg", b"PK\x03\x04 and more of a zip"),
            ("cut.jpg", b"\xff\xd8\xff" + bytes(1000)),
            ("empty.jpg", b""),
            ("large.jpg", b"\xff\xd8\xff" + bytes(300_000)),
            ("same.jpg", photo_bytes(1)),
        ],
        {"latitude": 95, "longitude": 7},
    )
    job = batches.finish(job_id, batches.new_worker(max_file_size=100_000))
    assert job["state"] == "succeeded"
    assert counts(job) == (2, 8, 6)
    items = batches.items(job_id)
    assert codes(items) == [
        "invalid_field",
        None,
        "unsupported_photo",
        "unsupported_photo",
        "undecodable_photo",
        "empty_file",
        "file_too_large",
        None,
    ]
    assert items[0]["error"]["line"] == 1
    assert items[0]["error"]["detail"].startswith("Line 1: latitude: ")
    assert "placewise index" in items[3]["error"]["detail"]
    assert items[7]["already_there"]
    assert items[7]["file_id"] == items[1]["file_id"]
    assert [photo.filename for photo in batches.photos()] == ["good.jpg"]
    assert len(batches.keys("originals/")) == 1, "what is refused leaves no bytes"
    assert codes(batches.items(job_id, state="failed")) == [c for c in codes(items) if c]


def test_uploaded_files_fail_one_by_one_and_what_is_refused_leaves_no_bytes(
    batches: Batches,
) -> None:
    whole = photo_bytes(1)
    torn = whole[: whole.index(b"\xff\xda")] + bytes(2)  # seen when it is described
    job_id = batches.start(
        ("text.jpg", b"no photo"),
        *files(1),
        ("cut.jpg", b"\xff\xd8\xff" + bytes(1000)),
        ("empty.jpg", b""),
        *files(1),
        ("torn.jpg", torn),
    )
    job = batches.finish(job_id)
    assert (job["state"], counts(job)) == ("succeeded", (2, 6, 4))
    items = batches.items(job_id)
    assert codes(items) == [
        "unsupported_photo",
        None,
        "undecodable_photo",
        "empty_file",
        None,
        "undecodable_photo",
    ]
    assert items[5]["file_id"]
    assert len(batches.keys("originals/")) == 2


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


def test_the_same_bytes_with_other_metadata_are_rejected(batches: Batches) -> None:
    batches.service.indexed(1, place="hall")
    manifest = lines({"filename": "1.jpg", "place": "yard"})
    job_id = batches.start(*files(1), manifest=manifest)
    batches.finish(job_id)
    assert codes(batches.items(job_id)) == ["photo_differs"]
    assert len(batches.keys("originals/")) == 1


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
    job_id = batches.start(*files(*range(10)))
    worker = batches.new_worker(ahead_photos=4)
    for _ in range(3):
        batches.work(worker)
    assert queued_photos(batches.catalog) == 4
    assert Counter(batches.states(job_id)) == {"running": 4, "queued": 6}
    batches.service.drain()
    batches.work(worker)
    assert Counter(batches.states(job_id)) == {"succeeded": 4, "running": 4, "queued": 2}
    assert counts(batches.finish(job_id, worker)) == (10, 10, 0)


def test_uploads_have_priority_over_photos_of_batches(batches: Batches) -> None:
    batches.start(*files(*range(4)))
    batches.work()
    upload = batches.service.upload(photo_bytes(9))
    with batches.catalog.read() as session:
        first = session.scalar(select(Job.id).order_by(Job.priority.desc(), Job.id).limit(1))
    assert str(first) == upload["job_id"]


def test_batches_are_processed_in_turn(batches: Batches, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker_module, "SLICE_SECONDS", 0.0)
    jobs = [batches.start(*files(*range(begin, begin + 3))) for begin in (0, 10)]
    monkeypatch.setattr(worker_module, "YIELD_SECONDS", 60.0)
    for _ in range(2):
        assert batches.worker.run_next(threading.Event())
    assert [batches.job(job_id)["state"] for job_id in jobs] == ["running", "running"]


def test_cancelling_ends_what_has_not_ended(batches: Batches) -> None:
    batches.service.indexed(0)
    job_id = batches.start(*files(*range(8)))
    worker = batches.new_worker(ahead_photos=3)
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
    problem(batches.service("POST", f"/jobs/{job_id}/cancel"), 409, "job_finished")


def test_a_cancelled_batch_cancels_its_photos_in_small_transactions(
    batches: Batches, monkeypatch: pytest.MonkeyPatch
) -> None:
    job_id = batches.start(*files(*range(7)))
    batches.work(batches.new_worker(ahead_photos=5))
    monkeypatch.setattr("shared.jobs.transitions.CANCELLED_PER_TRANSACTION", 2)
    cancelled = batches.service.json("POST", f"/jobs/{job_id}/cancel")
    assert cancelled["state"] == "cancelled"
    assert Counter(batches.states(job_id)) == {"cancelled": 4, "running": 3}
    cancel_items_of_ended_batches(batches.catalog)
    assert Counter(batches.states(job_id)) == {"cancelled": 6, "running": 1}
    assert queued_photos(batches.catalog) == 1
    batches.service.drain()  # which describes the last before it is cancelled
    for _ in range(2):
        cancel_items_of_ended_batches(batches.catalog)
        assert Counter(batches.states(job_id)) == {"cancelled": 6, "succeeded": 1}


def test_retry_queues_the_failed_items_again_whose_bytes_are_there(batches: Batches) -> None:
    batches.store.put("imports/1.jpg", photo_bytes(1))
    manifest = lines({"key": "imports/1.jpg"}, {"key": "imports/2.jpg"})
    form = {"manifest": ("m.jsonl", manifest)}
    started = batches.service.json("POST", "/upload/batch", 202, files=form)
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
    job_id = batches.start(*files(*range(6)))
    batches.work(batches.new_worker(ahead_photos=4))
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
