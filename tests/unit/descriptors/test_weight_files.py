"""Downloads: they go on where they broke off, and what has another hash is refused."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path

import httpx2
import numpy as np
import pytest

from shared.descriptors import weight_files
from shared.descriptors.weight_files import MAX_DOWNLOAD_ATTEMPTS, download_file
from shared.errors import Misconfigured
from tests.support.files_server import FilesServer, files_server

CONTENT = np.random.default_rng(0).bytes(5_000_000)
HASH = hashlib.sha256(CONTENT).hexdigest()


@pytest.fixture(autouse=True)
def _no_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(weight_files, "RETRY_PAUSE_SECONDS", 0)


@pytest.fixture
def server() -> Iterator[FilesServer]:
    with files_server() as started:
        started.files["/weights"] = CONTENT
        yield started


@pytest.fixture
def target(tmp_path: Path) -> Path:
    return tmp_path / "folder" / "weights.pth"


def begun(target: Path) -> Path:
    return target.with_name("weights.pth.part")


def break_off(server: FilesServer, target: Path) -> int:
    """The download ends in an error, as with a network that is gone; the bytes that were stored."""
    server.break_after = [2_000_000]
    server.refuse = []
    with pytest.raises(httpx2.HTTPError):
        # The first answer breaks off; every later one brings nothing.
        download_file(f"{server.url}/weights", target, on_progress=lambda *_: _refuse_all(server))
    return begun(target).stat().st_size


def _refuse_all(server: FilesServer) -> None:
    server.refuse = [503] * MAX_DOWNLOAD_ATTEMPTS


def test_a_download_reports_its_progress(server: FilesServer, target: Path) -> None:
    seen: list[tuple[int, int | None]] = []
    download_file(
        f"{server.url}/weights",
        target,
        sha256=HASH,
        on_progress=lambda done, total: seen.append((done, total)),
    )
    assert target.read_bytes() == CONTENT
    assert seen[0] == (0, len(CONTENT))
    assert seen[-1] == (len(CONTENT), len(CONTENT))
    assert not begun(target).exists()


def test_an_interrupted_download_is_resumed(server: FilesServer, target: Path) -> None:
    server.break_after = [2_000_000, 1_000_000]
    download_file(f"{server.url}/weights", target, sha256=HASH)
    assert target.read_bytes() == CONTENT
    assert [part for _, part in server.requests] == [None, "bytes=2000000-", "bytes=3000000-"]


def test_a_later_call_resumes_an_incomplete_download(server: FilesServer, target: Path) -> None:
    retained = break_off(server, target)
    assert 0 < retained <= 2_000_000
    assert not target.exists()
    server.refuse, server.requests = [], []
    seen: list[int] = []
    download_file(
        f"{server.url}/weights", target, sha256=HASH, on_progress=lambda done, _: seen.append(done)
    )
    assert target.read_bytes() == CONTENT
    assert server.requests == [("/weights", f"bytes={retained}-")]
    assert seen[0] == retained


def test_a_file_that_changed_on_the_server_is_downloaded_from_the_start(
    server: FilesServer, target: Path
) -> None:
    break_off(server, target)
    server.refuse = []
    server.files["/weights"] = changed = CONTENT[::-1]
    download_file(f"{server.url}/weights", target)
    assert target.read_bytes() == changed


def test_a_server_without_ranges_sends_all_of_it_again(server: FilesServer, target: Path) -> None:
    server.ranges = False
    server.break_after = [2_000_000]
    download_file(f"{server.url}/weights", target, sha256=HASH)
    assert target.read_bytes() == CONTENT
    assert [part for _, part in server.requests] == [None, None]


@pytest.mark.parametrize("more", [b"", b"more"])
def test_a_complete_download_is_not_requested_again_and_more_than_that_is_thrown_away(
    server: FilesServer, target: Path, more: bytes
) -> None:
    break_off(server, target)
    server.refuse = []
    begun(target).write_bytes(CONTENT + more)
    download_file(f"{server.url}/weights", target, sha256=HASH)
    assert target.read_bytes() == CONTENT
    if not more:
        assert server.requests[-1] == ("/weights", f"bytes={len(CONTENT)}-")


@pytest.mark.parametrize("expected", ["0" * 64, "0123abcd"])
def test_a_file_with_another_hash_is_rejected_and_deleted(
    server: FilesServer, target: Path, expected: str
) -> None:
    with pytest.raises(Misconfigured, match="is not the expected file") as caught:
        download_file(f"{server.url}/weights", target, sha256=expected)
    assert caught.value.code == "download_corrupt"
    assert {path.suffix for path in target.parent.iterdir()} <= {".lock"}


def test_a_missing_file_is_requested_once(server: FilesServer, target: Path) -> None:
    with pytest.raises(httpx2.HTTPStatusError, match="404"):
        download_file(f"{server.url}/others", target)
    assert len(server.requests) == 1


def test_a_request_to_a_busy_server_is_retried(server: FilesServer, target: Path) -> None:
    server.refuse = [503, 429]
    download_file(f"{server.url}/weights", target, sha256=HASH[:8].upper())
    assert target.read_bytes() == CONTENT


def test_an_existing_file_is_not_requested(server: FilesServer, target: Path) -> None:
    target.parent.mkdir()
    target.write_bytes(b"here")
    download_file(f"{server.url}/weights", target, sha256=HASH)
    assert target.read_bytes() == b"here"
    assert server.requests == []
