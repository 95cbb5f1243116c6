"""The disk space that is set aside for the catalog."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from types import SimpleNamespace

import pytest

from shared.config.embedded_home import announce_server, server_address_file
from shared.errors import StorageFull
from shared.storage import FolderStore
from shared.storage.folder import RESERVED_FREE_BYTES

GIGABYTE = 1_000_000_000


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    free = SimpleNamespace(free=GIGABYTE)
    monkeypatch.setattr("shared.storage.folder.shutil.disk_usage", lambda folder: free)
    return free


def test_the_object_store_keeps_free_space_for_the_catalog(
    tmp_path: Path, disk: SimpleNamespace
) -> None:
    store = FolderStore(tmp_path)
    disk.free = RESERVED_FREE_BYTES - 1
    with pytest.raises(StorageFull):
        store.put("originals/a", b"some")
    assert list(store.list("")) == []
    disk.free = RESERVED_FREE_BYTES
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
