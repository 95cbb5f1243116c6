"""The disk space that is set aside for the catalog."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from types import SimpleNamespace

import pytest

from shared.config.disk_space import RESERVE_BYTES, DiskReserve
from shared.config.embedded_home import announce_server, server_address_file
from shared.errors import StorageFull
from shared.storage import FolderStore

GIGABYTE = 1_000_000_000


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    free = SimpleNamespace(free=GIGABYTE)
    monkeypatch.setattr("shared.config.disk_space.shutil.disk_usage", lambda folder: free)
    return free


def test_the_reserve_is_freed_on_a_full_disk_and_written_again_once_there_is_room(
    tmp_path: Path, disk: SimpleNamespace
) -> None:
    reserve, file = DiskReserve(tmp_path, GIGABYTE // 2), tmp_path / "reserve.bin"
    reserve.maintain()
    status = file.stat()
    assert (status.st_size, status.st_mode & 0o777) == (RESERVE_BYTES, 0o600)
    assert status.st_blocks * 512 >= RESERVE_BYTES, "a hole reserves nothing"
    disk.free = 0
    reserve.release()
    assert not file.exists()
    disk.free = GIGABYTE // 2
    reserve.maintain()
    assert not file.exists(), "uploads would be refused for it"
    disk.free += RESERVE_BYTES
    reserve.maintain()
    assert file.exists()


def test_a_reserve_file_without_room_is_removed(
    tmp_path: Path, disk: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("shared.config.disk_space.os.posix_fallocate", full, raising=False)
    DiskReserve(tmp_path, 0).maintain()
    assert list(tmp_path.iterdir()) == []


def test_the_object_store_keeps_free_space_for_the_catalog(
    tmp_path: Path, disk: SimpleNamespace
) -> None:
    store = FolderStore(tmp_path)
    disk.free = RESERVE_BYTES - 1
    with pytest.raises(StorageFull):
        store.put("originals/a", b"some")
    assert list(store.list("")) == []
    disk.free = RESERVE_BYTES
    store.put("originals/a", b"some")


def test_a_server_without_room_for_its_address_starts_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    server_address_file(tmp_path).write_text("of a server that was killed")
    monkeypatch.setattr("shared.config.embedded_home.write_private", full)
    with announce_server(tmp_path, "http://127.0.0.1:1"):
        assert not server_address_file(tmp_path).exists()
    assert "--server http://127.0.0.1:1" in caplog.text
