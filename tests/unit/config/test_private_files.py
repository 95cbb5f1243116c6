"""What is stored can be read by the service's own user alone, whatever the umask is."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from hashlib import sha256
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from lab.evaluation.descriptor_cache import CachedDescriber
from services.cli.operations.installation_checks import check_permissions
from services.cli.recovery.backup import create_backup
from services.search.chunk_loader import MappedFileCache
from shared.catalog.database.schema import migrate
from shared.catalog.database.session import Catalog
from shared.config.embedded_home import announce_server, find_running_server, lock_home
from shared.config.private_files import create_private_file, make_private_folder, write_private
from shared.config.settings import Settings
from shared.errors import Misconfigured
from shared.ids import new_id
from shared.storage import FolderStore
from shared.storage.open_store import resolve_upload_dir


@pytest.fixture
def no_umask() -> Iterator[None]:
    """As in a shell in which every new file can be read and written by everyone."""
    before = os.umask(0)
    yield
    os.umask(before)


def check_private(folder: Path) -> int:
    found = [folder, *folder.rglob("*")]
    for path in found:
        assert stat.S_IMODE(path.stat().st_mode) == (0o700 if path.is_dir() else 0o600), path
    return len(found)


@pytest.mark.usefixtures("no_umask")
def test_home_catalog_and_marks_are_private(tmp_path: Path) -> None:
    home = tmp_path / "deep" / "home"
    with lock_home(home), announce_server(home, "http://localhost"):
        catalog = Catalog(f"sqlite:///{home / 'catalog.sqlite'}")
        migrate(catalog)
        resolve_upload_dir(home, home / "objects", home / "photos")
        with catalog.write():
            assert {path.name for path in home.iterdir()} >= {
                "catalog.sqlite-wal",
                "catalog.sqlite-shm",
                "server.lock",
                "server.json",
            }
            check_private(tmp_path / "deep")
        catalog.close()


def test_server_that_starts_is_waited_for(tmp_path: Path) -> None:
    with lock_home(tmp_path), ThreadPoolExecutor() as pool:
        assert find_running_server(tmp_path) is None
        found = pool.submit(lambda: find_running_server(tmp_path, 60))
        assert wait([found], timeout=0.3).not_done
        with announce_server(tmp_path, "http://localhost"):
            assert getattr(found.result(), "url", None) == "http://localhost"


def test_no_server_is_found_in_a_folder_of_another_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Path, "stat", Mock(side_effect=PermissionError))
    assert find_running_server(tmp_path) is None


@pytest.mark.usefixtures("no_umask")
def test_backup_is_private(migrated_sqlite: Path, tmp_path: Path) -> None:
    store = FolderStore(tmp_path / "objects")
    store.put("thumbnails/a.jpg", b"photo")
    catalog = Catalog(f"sqlite:///{migrated_sqlite}")
    create_backup(catalog, store, new_id(), tmp_path / "backup")
    assert check_private(tmp_path / "backup") > 5
    catalog.close()


@pytest.mark.usefixtures("no_umask")
def test_caches_are_private(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def describe(photos: Sequence[Path]) -> Iterator[Any]:
        yield np.zeros((len(photos), 4), np.float32)

    describe.seconds, describe.photos = 0.0, 0  # type: ignore[attr-defined]
    (tmp_path / "photo.jpg").write_bytes(b"photo")
    retained = CachedDescriber(describe, tmp_path / "rows", {}, max_bytes=10**9)  # type: ignore[arg-type]
    list(retained([tmp_path / "photo.jpg"]))
    store = FolderStore(tmp_path / "objects")
    store.put("chunks/a.npy", b"rows")
    monkeypatch.setattr(store, "file", lambda key: None)  # as a bucket
    MappedFileCache(store, tmp_path / "search").map_object(
        "chunks/a.npy", sha256(b"rows").hexdigest()
    )
    for folder in ("rows", "search"):
        assert check_private(tmp_path / folder) > 1


@pytest.mark.usefixtures("no_umask")
def test_folder_that_exists_keeps_its_mode_and_a_file_is_no_folder(tmp_path: Path) -> None:
    (tmp_path / "wide").mkdir(0o755)
    make_private_folder(tmp_path / "wide")
    assert stat.S_IMODE((tmp_path / "wide").stat().st_mode) == 0o755
    with create_private_file(tmp_path / "file") as file:
        file.write(b"x")
    for path in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(NotADirectoryError):
            make_private_folder(path)


@pytest.mark.usefixtures("no_umask")
def test_doctor_names_what_others_can_read_and_how_to_change_it(tmp_path: Path) -> None:
    home, photos = tmp_path / "home", tmp_path / "photos"
    settings = Settings(placewise_home=home, upload_dir=photos)
    assert "nothing" in check_permissions(settings)
    home.mkdir(0o755)
    photos.mkdir(0o750)
    (home / "catalog.sqlite").touch(0o644)
    with pytest.raises(Misconfigured) as caught:
        check_permissions(settings)
    assert f"chmod -R go-rwx '{home}' '{photos}' '{home / 'catalog.sqlite'}'" in caught.value.detail
    assert stat.S_IMODE(home.stat().st_mode) == 0o755, "it changes nothing by itself"
    for folder in (home, photos):
        folder.chmod(0o700)
    assert "only this user" in check_permissions(settings)


def test_a_private_file_replaces_one_that_others_can_read(tmp_path: Path) -> None:
    for left_over in (file := tmp_path / "secret", tmp_path / ".secret.partial"):
        left_over.write_text("of a killed process")
        left_over.chmod(0o644)
    write_private(file, "new")
    assert file.read_text() == "new"
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert list(tmp_path.iterdir()) == [file]
