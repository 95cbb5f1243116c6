"""Chunks that are damaged or gone: the rest is answered, and everything says what is missing."""

from __future__ import annotations

import errno
import shutil
import sqlite3
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import event, func, select
from sqlalchemy.exc import OperationalError

from services.search import chunk_loader
from shared.catalog.chunks import Chunk
from shared.catalog.maps import Search
from shared.integrity.verify import repair_descriptors, verify_store
from shared.jobs import InProcessWakeups
from shared.storage import FolderStore, ObjectStore, read_retries
from shared.storage.copying import download_object
from shared.storage.s3 import S3Store
from tests.integration.in_process_api import Service
from tests.support.problems import problem
from tests.support.servers import S3Server


@pytest.fixture(params=["folder", "bucket"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> ObjectStore:
    if request.param == "folder":
        return FolderStore(tmp_path / "objects")
    s3: S3Server = request.getfixturevalue("s3")
    return S3Store(s3.new_bucket())


def restarted(service: Service) -> Service:
    """The service as on a new machine: nothing is loaded, and nothing of a bucket is cached."""
    shutil.rmtree(service.settings.search_cache_folder, ignore_errors=True)
    again = Service(service.catalog, service.store, service.settings, service.make_worker)
    again.search.sync()
    return again


def first_chunk(service: Service) -> str:
    with service.catalog.read() as session:
        return session.scalars(select(Chunk.object_key).order_by(Chunk.id)).first() or ""


def similar(service: Service, photo: str) -> dict[str, Any]:
    found: dict[str, Any] = service.json("POST", f"/similarity/{photo}")
    return found


@pytest.mark.parametrize("damage", ["flipped", "gone"])
def test_a_damaged_chunk_is_named_in_missing_until_it_is_repaired(
    service: Service, monkeypatch: pytest.MonkeyPatch, damage: str
) -> None:
    monkeypatch.setattr(read_retries, "FIRST_RETRY_SECONDS", 0.0)
    (lost,) = service.indexed(1)
    searched, other = (*service.indexed(2), *service.indexed(3))
    whole = similar(service, searched)
    assert (whole["certificate"], whole["degraded"], whole["total_similar"]) == (
        "exhaustive",
        False,
        2,
    )
    key = first_chunk(service)
    data = service.store.get(key)
    if damage == "gone":
        service.store.delete(key)
    else:
        service.store.put(key, data[:-1] + bytes([data[-1] ^ 1]))

    service = restarted(service)
    found = similar(service, searched)
    assert [image["image_id"] for image in found["similar_images"]] == [other]
    assert (found["degraded"], found["missing"]) == (True, [key])
    assert found["certificate"] == "none"
    problem(service("POST", f"/similarity/{lost}"), 503, "chunk_unreadable")
    assert service("GET", "/../../readyz").status_code == 200
    health = service("GET", "/health").json()
    assert health["status"] == health["parts"]["search"]["status"] == "degraded"
    assert key in health["parts"]["search"]["detail"]

    report = verify_store(service.catalog, service.store, originals=False)
    assert repair_descriptors(service.catalog, InProcessWakeups(), report) == 1
    service.drain()
    service.search.sync()
    mended = similar(service, searched)
    assert mended["similar_images"] == whole["similar_images"]
    assert (mended["certificate"], mended["missing"]) == ("exhaustive", [])
    assert service.json("GET", "/health")["status"] == "healthy"


@pytest.mark.parametrize("store", ["folder"], indirect=True)
def test_a_search_is_answered_while_the_catalog_has_no_room_for_its_history(
    service: Service, caplog: pytest.LogCaptureFixture
) -> None:
    searched, other = (*service.indexed(1), *service.indexed(2))

    def full(*_: object) -> None:
        original = sqlite3.OperationalError("database or disk is full")
        original.sqlite_errorname = "SQLITE_FULL"
        raise OperationalError("INSERT", {}, original)

    event.listen(Search, "before_insert", full)
    try:
        found = similar(service, searched)
    finally:
        event.remove(Search, "before_insert", full)
    assert [image["image_id"] for image in found["similar_images"]] == [other]
    assert "is not added to the history" in caplog.text
    with service.catalog.read() as session:
        assert session.scalar(select(func.count()).select_from(Search)) == 0


@pytest.mark.parametrize("store", ["bucket"], indirect=True)
def test_a_full_disk_of_the_cache_is_not_taken_for_damage(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(read_retries, "FIRST_RETRY_SECONDS", 0.0)
    service.indexed(1)
    (searched,) = service.indexed(2)
    chunk = first_chunk(service)

    def full(store: ObjectStore, key: str, target: Path) -> str:
        if key == chunk:
            raise OSError(errno.ENOSPC, "No space left on device", str(target))
        return download_object(store, key, target)

    with monkeypatch.context() as disk:
        disk.setattr(chunk_loader, "download_object", full)
        service = restarted(service)
        assert similar(service, searched)["missing"] == [chunk]
        detail = service("GET", "/health").json()["parts"]["search"]["detail"]
        assert "disk of a search worker is full" in detail
        assert "--repair" not in detail
    service.search.sync()
    assert similar(service, searched)["missing"] == []
    assert service("GET", "/health").json()["parts"]["search"]["status"] == "healthy"
