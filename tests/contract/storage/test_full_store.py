"""A full or overloaded store: the error says so, and nothing of the object is left."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from http.server import ThreadingHTTPServer

import httpx2
import pytest
from sqlalchemy import func, select
from starlette.testclient import TestClient

from services.gateway.app import create_app
from services.gateway.authentication import LocalhostAuthenticator
from services.gateway.dependencies import GatewayContext
from services.search.worker import SearchWorker
from shared.catalog.database.session import Catalog
from shared.catalog.maps import get_or_create_default_map
from shared.catalog.photos import Photo
from shared.config.settings import Settings
from shared.errors import StorageFull, Unavailable
from shared.jobs import InProcessWakeups, Job
from shared.storage import FolderStore
from shared.storage.s3 import S3Store
from tests.support.fake_server import QuietHandler, serving
from tests.support.photos import photo_bytes
from tests.support.problems import problem
from tests.support.servers import S3Server

MEGABYTE = 1_000_000


class FullS3(ThreadingHTTPServer):
    """Answers every PUT and POST with one refusal."""

    def __init__(self, status: int, code: str) -> None:
        super().__init__(("127.0.0.1", 0), Refuses)
        self.status = status
        self.body = f"<Error><Code>{code}</Code><Message>No.</Message></Error>".encode()

    def store(self) -> S3Store:
        endpoint = f"127.0.0.1:{self.server_address[1]}"
        return S3Store(S3Server(endpoint, "someone", "a secret", False, None).bucket("placewise"))


class Refuses(QuietHandler):
    server: FullS3
    protocol_version = "HTTP/1.1"

    def answer(self) -> None:
        self.rfile.read(int(self.headers.get("Content-Length") or 0))
        self.reply(self.server.status, self.server.body, {"Content-Type": "application/xml"})

    do_PUT = do_POST = answer  # noqa: N815

    def do_DELETE(self) -> None:  # noqa: N802
        self.send_response(204)
        self.end_headers()


REFUSALS = [
    (507, "XMinioStorageFull", "object_store_full", 507),
    (507, "InsufficientStorage", "object_store_full", 507),
    (403, "QuotaExceeded", "object_store_full", 507),
    (503, "SlowDown", "object_store_busy", 503),
    (503, "ServiceUnavailable", "object_store_busy", 503),
    (500, "InternalError", "object_store_unavailable", 503),
]


@pytest.fixture(params=REFUSALS, ids=lambda refusal: f"{refusal[0]} {refusal[1]}")
def refusal(request: pytest.FixtureRequest) -> tuple[int, str, str, int]:
    found: tuple[int, str, str, int] = request.param
    return found


@pytest.fixture
def full(refusal: tuple[int, str, str, int]) -> Iterator[S3Store]:
    with FullS3(*refusal[:2]) as server, serving(server):
        yield server.store()


@pytest.mark.parametrize("size", [1000, 12 * MEGABYTE], ids=["one request", "parts"])
def test_what_a_bucket_refuses_has_its_meaning(
    full: S3Store, refusal: tuple[int, str, str, int], size: int
) -> None:
    with pytest.raises(Unavailable) as caught:
        full.put("a", bytes(size))
    assert (caught.value.code, caught.value.status) == refusal[2:]
    assert isinstance(caught.value, StorageFull) == (refusal[3] == 507)


@pytest.mark.databases("sqlite")  # which is the same to a store that is full
@pytest.mark.parametrize("refusal", [REFUSALS[0], REFUSALS[3]], indirect=True)
@pytest.mark.parametrize("path", ["/upload", "/similarity"])
def test_nothing_is_acknowledged_that_was_not_stored(
    full: S3Store,
    refusal: tuple[int, str, str, int],
    catalog: Catalog,
    settings: Settings,
    path: str,
) -> None:
    with catalog.write() as session:
        get_or_create_default_map(session, settings.extractor)
    search = SearchWorker(catalog, full, settings)
    gateway = GatewayContext(
        catalog, full, InProcessWakeups(), search, settings, LocalhostAuthenticator()
    )
    client = TestClient(create_app(gateway), base_url="http://localhost")
    answer: httpx2.Response = client.post(
        f"/api/v1{path}",
        files={"file": ("photo.jpg", photo_bytes(1))},
        headers={"Idempotency-Key": "k"},
    )
    problem(answer, refusal[3], refusal[2])
    assert int(answer.headers["retry-after"]) >= 1
    with catalog.read() as session:
        for table in (Photo, Job):
            assert session.scalar(select(func.count()).select_from(table)) == 0


class FullFile:
    """Takes some bytes, and then none."""

    def __init__(self, room: int, reason: int) -> None:
        self.room = room
        self.reason = reason

    def write(self, data: memoryview) -> int:
        if not self.room:
            raise OSError(self.reason, os.strerror(self.reason))
        taken = min(self.room, len(data))
        self.room -= taken
        return taken

    def close(self) -> None:
        """Like a file's."""


@pytest.mark.parametrize("reason", [errno.ENOSPC, errno.EDQUOT], ids=["disk", "quota"])
def test_a_full_disk_is_reported_unlike_another_fault_and_leaves_no_object(
    store: FolderStore, reason: int
) -> None:
    writer = store.writer("originals/a")
    writer.write(b"some")
    writer._file.close()
    writer._file = FullFile(100, reason)  # type: ignore[assignment]
    with pytest.raises(StorageFull) as caught:
        writer.write(bytes(1000))
    assert caught.value.code == "disk_full"
    assert str(store.root) not in caught.value.detail
    writer.abort()
    assert list(store.list("")) == []
    assert list((store.root / ".partial").iterdir()) == []
    writer = store.writer("originals/a")
    writer._file.close()
    writer._file = FullFile(0, errno.EIO)  # type: ignore[assignment]
    with pytest.raises(OSError, match="Input/output"):
        writer.write(b"some")
    writer.abort()


def test_a_disk_that_fills_up_while_it_syncs_is_full_too(
    store: FolderStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("shared.storage.folder.os.fsync", full)
    with pytest.raises(StorageFull):
        store.put("originals/a", b"some")
    assert store.head("originals/a") is None
