"""Batches through the HTTP API and a batch worker, step by step."""

from __future__ import annotations

import json
import threading
from typing import Any
from uuid import UUID

from sqlalchemy import select

from services.steward.batches.worker import BatchWorker
from shared.catalog.photos import Photo
from shared.config.settings import Settings
from shared.jobs import InProcessWakeups
from shared.jobs.runner import reclaim_expired_leases
from shared.storage.keys import TRASH
from tests.integration.in_process_api import Service
from tests.support.catalog_rows import end_pauses, expire_lease
from tests.support.photos import photo_bytes

ROUNDS = 60


class Batches:
    """A service with the steward's batches."""

    def __init__(self, service: Service, settings: Settings) -> None:
        self.service, self.settings = service, settings
        self.catalog, self.store = service.catalog, service.store
        self.worker = self.new_worker()

    def new_worker(self, ahead_photos: int | None = None, **changed: Any) -> BatchWorker:
        """As after a restart, with other settings if need be."""
        settings = self.settings.model_copy(update=changed)
        return BatchWorker(
            self.catalog,
            self.store,
            InProcessWakeups(),
            settings,
            "steward",
            ahead_photos=ahead_photos,
        )

    def start(self, *files: tuple[str, bytes], **parts: Any) -> UUID:
        """`POST /upload/batch` with these files, and a `manifest` or `prefix`; its job."""
        sent: list[tuple[str, Any]] = [("file", file) for file in files]
        if "manifest" in parts:
            sent.append(("manifest", ("manifest.jsonl", parts["manifest"])))
        if "prefix" in parts:
            sent.append(("prefix", (None, parts["prefix"])))
        started = self.service.json("POST", "/upload/batch", 202, files=sent)
        return UUID(started["job_id"])

    def start_import(self, photos: list[tuple[str, bytes]], *fields: dict[str, Any]) -> UUID:
        """A batch of objects with these names and bytes, and of the fields of the first ones."""
        entries = []
        for number, (name, data) in enumerate(photos):
            self.store.put(f"imports/{name}", data)
            entries.append({"key": f"imports/{name}", **(fields[number : number + 1] or [{}])[0]})
        return self.start(manifest=lines(*entries))

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


def counts(job: dict[str, Any]) -> tuple[int, int, int]:
    progress = job["progress"]
    return progress["done"], progress["total"], progress["failed"]


def codes(items: list[dict[str, Any]]) -> list[str | None]:
    return [item["error"] and item["error"]["code"] for item in items]


def files(*numbers: int) -> list[tuple[str, bytes]]:
    return [(f"{number}.jpg", photo_bytes(number)) for number in numbers]


def lines(*objects: dict[str, Any]) -> bytes:
    return b"".join(json.dumps(one).encode() + b"\n" for one in objects)


class Killed(BaseException):
    pass


def restart(batches: Batches, job_id: UUID) -> BatchWorker:
    """Another steward, once the dead one's lease is over."""
    expire_lease(batches.catalog, job_id)
    with batches.catalog.write() as session:
        assert len(reclaim_expired_leases(session)) == 1
    return batches.new_worker()
