"""The folder store: the contract of every object store, and what only a folder does."""

from __future__ import annotations

import os
import stat
from datetime import date
from pathlib import Path
from types import SimpleNamespace

import pytest

from shared.errors import Unavailable
from shared.storage import FolderStore
from shared.storage.keys import trash_key
from tests.contract.storage.test_object_store import ObjectStoreContract, keys_of


class TestFolderStore(ObjectStoreContract):
    def test_nearly_full_disk_frees_the_oldest_trash_until_there_is_room(
        self, store: FolderStore, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        days = [date(2026, 11, day) for day in (20, 21, 22)]
        for day in days:
            store.put(trash_key("originals/a", day), bytes(1000))
        store.put("originals/b", b"no garbage")

        def usage(_: Path) -> object:
            return SimpleNamespace(free=10_000 - 1000 * len(keys_of(store, "trash/")))

        monkeypatch.setattr("shared.storage.folder.shutil.disk_usage", usage)
        assert store.free_trash(7000) == 0
        assert store.free_trash(8500) == 2
        assert keys_of(store) == ["originals/b", trash_key("originals/a", days[-1])]
        assert [path.name for path in (store.root / "trash").iterdir()] == ["2026-11-22"]

    def test_files_and_folders_are_private_whatever_the_umask_is(self, tmp_path: Path) -> None:
        before = os.umask(0)
        try:
            store = FolderStore(tmp_path / "new" / "objects", {"originals": tmp_path / "photos"})
            for key in ("originals/a", "chunks/deep/b"):
                store.put(key, b"bytes")
            store.move("originals/a", trash_key("originals/a", date(2026, 11, 22)))
            store.write_note(".placewise", b"owner")
        finally:
            os.umask(before)
        for path in tmp_path.rglob("*"):
            assert stat.S_IMODE(path.stat().st_mode) == (0o700 if path.is_dir() else 0o600), path

    def test_the_names_of_its_own_files_are_no_keys_and_strange_files_are_not_listed(
        self, store: FolderStore
    ) -> None:
        for key in (".partial/a", ".placewise"):
            with pytest.raises(ValueError):
                store.put(key, b"x")
            with pytest.raises(ValueError):
                store.head(key)
        (store.root / "back\\slash").write_bytes(b"put there by hand")
        assert keys_of(store) == []

    @pytest.mark.parametrize("key", ["a", "a/b/c"])
    def test_a_file_is_no_folder(self, store: FolderStore, key: str) -> None:
        store.put("a/b", b"x")
        with pytest.raises(ValueError, match="parent of another key"):
            store.put(key, b"x")
        assert keys_of(store) == ["a/b"]

    def test_leftovers_of_a_killed_writer_are_removed_by_the_only_process_of_the_folder(
        self, store: FolderStore
    ) -> None:
        store.put("a", b"whole")
        killed = store.writer("b")
        killed.write(b"half")
        partial = store.root / ".partial"
        assert len(list(partial.iterdir())) == 1
        assert keys_of(store) == ["a"]
        assert keys_of(store, ".partial/") == []
        running = store.writer("c")
        running.write(b"whole")
        other_process = FolderStore(store.root, exclusive=False)
        running.commit()
        assert other_process.get("c") == b"whole"
        assert len(list(partial.iterdir())) == 1
        again = FolderStore(store.root)
        assert list(partial.iterdir()) == []
        assert keys_of(again) == ["a", "c"]
        killed.abort()

    def test_commit_reaches_the_disk_before_it_returns(
        self, store: FolderStore, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        order: list[str] = []
        fsync, replace = os.fsync, Path.replace

        def noted_fsync(descriptor: int) -> None:
            order.append("fsync")
            fsync(descriptor)

        def noted_replace(source: Path, target: Path) -> Path:
            order.append("rename")
            return replace(source, target)

        monkeypatch.setattr(os, "fsync", noted_fsync)
        monkeypatch.setattr(Path, "replace", noted_replace)
        store.put("a", b"x")
        assert order == ["fsync", "rename", "fsync"], "file, name, folder"


class TestFolderStoreWithOriginalsElsewhere(ObjectStoreContract):
    """The same promises where some of the keys lie in other folders."""

    @pytest.fixture
    def store(self, tmp_path: Path) -> FolderStore:
        elsewhere = {"originals": tmp_path / "photos", "a": tmp_path / "deep" / "down"}
        return FolderStore(tmp_path / "objects", elsewhere)

    def test_each_key_lies_in_its_folder_and_nowhere_else(
        self, store: FolderStore, tmp_path: Path
    ) -> None:
        for key in ("originals/1", "originals/deep/2", "chunks/3", "originals-too/4"):
            store.put(key, key.encode())
        files = {
            path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if path.is_file()
        }
        assert files == {"photos/1", "photos/deep/2", "objects/chunks/3", "objects/originals-too/4"}
        assert keys_of(store, "orig") == ["originals-too/4", "originals/1", "originals/deep/2"]
        assert keys_of(store, "originals/d") == ["originals/deep/2"]

    def test_trash_of_another_folder_lies_on_its_own_disk(
        self, store: FolderStore, tmp_path: Path
    ) -> None:
        trashed = trash_key("originals/1", date(2026, 11, 22))
        store.put("originals/1", b"photo")
        store.move("originals/1", trashed)
        assert [path.name for path in (tmp_path / "photos").rglob("1")] == ["1"]
        assert keys_of(store) == [trashed]
        assert keys_of(store, "originals/") == []
        assert store.free_trash(2**62) == 1
        assert keys_of(store) == []
        assert not (tmp_path / "photos" / ".placewise-trash").exists()

    def test_files_are_half_written_on_the_disk_that_they_are_for(
        self, store: FolderStore, tmp_path: Path
    ) -> None:
        killed = store.writer("originals/half")
        killed.write(b"half")
        partial = tmp_path / "photos" / ".partial"
        assert len(list(partial.iterdir())) == 1
        assert keys_of(store) == []
        FolderStore(store.root, {"originals": tmp_path / "photos"})
        assert list(partial.iterdir()) == []
        killed.abort()

    def test_the_folders_own_names_are_no_keys_and_strange_files_are_not_listed(
        self, store: FolderStore, tmp_path: Path
    ) -> None:
        (tmp_path / "photos" / ".placewise").write_text("whose it is")
        assert keys_of(store, "originals/") == []
        for key in ("originals/.partial/a", "originals/.placewise", "originals/../b"):
            with pytest.raises(ValueError):
                store.head(key)
        (store.root / "originals").mkdir()
        (store.root / "originals" / "old").write_bytes(b"where its key does not lead")
        assert keys_of(store) == []
        assert store.head("originals/old") is None

    def test_one_folder_that_cannot_be_written_makes_the_store_unavailable(
        self, store: FolderStore, tmp_path: Path
    ) -> None:
        for name in ("objects", "photos"):
            (tmp_path / name / ".partial").rmdir()
            with pytest.raises(Unavailable, match=name) as caught:
                store.check()
            assert caught.value.code == "object_store_unavailable"
            (tmp_path / name / ".partial").mkdir()
