"""Batches: brought in by the steward, described by the extractors, once each whatever dies."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from typing import Any
from uuid import UUID

import pytest
from sqlalchemy import select

from services.steward.batches.worker import BatchWorker
from services.steward.collect import collect_archives
from shared.catalog.photos import Photo
from shared.jobs import InProcessHints
from shared.settings import Settings
from tests.integration.gateway import Service
from tests.support.archives import PACKED
from tests.support.catalog_rows import end_pauses
from tests.support.photos import photo_bytes

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
        return BatchWorker(self.catalog, self.store, InProcessHints(), settings, "steward")

    def start(self, *files: tuple[str, bytes], **parts: Any) -> UUID:
        """`POST /upload/batch` with these files, and `archive` or `manifest`; its job."""
        sent: list[tuple[str, Any]] = [("file", file) for file in files]
        if "archive" in parts:
            sent.append(("archive", ("photos", parts["archive"])))
        if "manifest" in parts:
            sent.append(("manifest", ("manifest.jsonl", parts["manifest"])))
        started = self.service.json("POST", "/upload/batch", 202, files=sent)
        return UUID(started["job_id"])

    def work(self, worker: BatchWorker | None = None) -> bool:
        """The next slice of a batch, without pauses."""
        end_pauses(self.catalog)
        return (worker or self.worker).work_next(threading.Event())

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
        return {info.key for info in self.store.list(prefix)}


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
    collect_archives(batches.catalog, batches.store)
    assert batches.keys("archives/") == set()
