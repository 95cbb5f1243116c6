"""The contract of every object store (`shared.storage.protocol`), and the S3 stores."""

from __future__ import annotations

import contextlib
import os
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, date, datetime, timedelta

import pytest

from shared.errors import NotFound
from shared.storage import FolderStore, ObjectStore, OwnedStore
from shared.storage.keys import OWNER_MARK, trash_key
from shared.storage.s3 import S3Store
from tests.support.servers import S3Server
from tests.support.threads import meanwhile

MEGABYTE = 1_000_000


def keys_of(store: ObjectStore, prefix: str = "") -> list[str]:
    return sorted(info.key for info in store.list(prefix))


class ObjectStoreContract:
    """Every promise of the port. A store's test class gives it a fixture named `store`."""

    def test_get_returns_the_bytes_of_put(self, store: ObjectStore) -> None:
        for key, data in {"a": b"one", "a-folder/b": bytes(range(256)), "empty": b""}.items():
            store.put(key, data)
            assert store.get(key) == data

    def test_object_of_several_megabytes_is_read_whole_by_seeking_and_by_ranges(
        self, store: ObjectStore
    ) -> None:
        # More than two parts of S3's, and a last one that is no whole part.
        size = 12 * MEGABYTE
        data = os.urandom(size)
        store.put("chunks/large", data)
        assert store.get("chunks/large") == data
        with store.open("chunks/large") as file:
            assert file.seekable()
            file.seek(5_242_870)
            assert file.read(20) == data[5_242_870:5_242_890]
            pieces = list(iter(lambda: file.read(MEGABYTE), b""))
            assert b"".join(pieces) == data[5_242_890:]
            file.seek(-3, os.SEEK_END)
            assert file.read() == data[-3:]
            assert file.read(1) == b""
            file.seek(2)
            file.seek(3, os.SEEK_CUR)
            assert file.tell() == 5
            assert file.read(1) == data[5:6]
        for begin, count in ((0, 10), (500_000, 1), (size - 10, 10), (0, MEGABYTE), (7, 300_000)):
            assert store.read_range("chunks/large", begin, count) == data[begin : begin + count]

    def test_range_beyond_the_end_is_truncated(self, store: ObjectStore) -> None:
        store.put("short", b"12345")
        for begin, size in ((4, 100), (5, 1), (6, 1), (1000, 10), (2, 0)):
            assert store.read_range("short", begin, size) == b"12345"[begin : begin + size]

    def test_writer_joins_what_is_written_piece_by_piece(self, store: ObjectStore) -> None:
        pieces = [os.urandom(size) for size in (1, 0, 100_000, 7, 300_000)]
        writer = store.writer("originals/pieces")
        for piece in pieces:
            writer.write(piece)
        writer.commit()
        assert store.get("originals/pieces") == b"".join(pieces)
        store.writer("empty").commit()
        assert store.get("empty") == store.read_range("empty", 0, 10) == b""

    def test_nothing_is_visible_before_commit(self, store: ObjectStore) -> None:
        writer = store.writer("originals/a")
        writer.write(os.urandom(MEGABYTE))
        assert keys_of(store) == []
        assert store.head("originals/a") is None
        with pytest.raises(NotFound):
            store.get("originals/a")
        writer.commit()
        assert keys_of(store) == ["originals/a"]

    def test_object_is_replaced_at_commit(self, store: ObjectStore) -> None:
        store.put("a", b"a long first version")
        writer = store.writer("a")
        writer.write(b"short")
        assert store.get("a") == b"a long first version"
        writer.commit()
        assert store.get("a") == b"short"
        assert keys_of(store) == ["a"]

    @pytest.mark.parametrize("size", [4, 12 * MEGABYTE])
    def test_abort_keeps_the_previous_object(self, store: ObjectStore, size: int) -> None:
        store.put("a", b"old")
        for key in ("a", "b"):
            writer = store.writer(key)
            writer.write(bytes(size))
            assert keys_of(store) == ["a"]
            writer.abort()
        assert keys_of(store) == ["a"]
        assert store.get("a") == b"old"
        assert store.head("b") is None

    def test_abort_after_commit_is_harmless(self, store: ObjectStore) -> None:
        writer = store.writer("a")
        writer.write(b"some")
        writer.commit()
        writer.abort()
        writer.abort()
        assert store.get("a") == b"some"

    def test_two_writers_of_one_key_do_not_mix(self, store: ObjectStore) -> None:
        first, second = store.writer("a"), store.writer("a")
        first.write(b"1" * 1000)
        second.write(b"2" * 1000)
        first.write(b"1" * 1000)
        second.commit()
        assert store.get("a") == b"2" * 1000
        first.commit()
        assert store.get("a") == b"1" * 2000

    def test_overwriting_is_atomic_for_readers(self, store: ObjectStore) -> None:
        versions = [bytes([number]) * 50_000 for number in range(8)]
        store.put("a", versions[0])
        found: set[bytes] = set()
        with meanwhile(lambda: found.add(store.get("a"))):
            for version in versions * 3:
                store.put("a", version)
        assert found <= set(versions)

    def test_open_reader_keeps_the_version_that_it_opened(self, store: ObjectStore) -> None:
        store.put("a", b"old" * 1000)
        with store.open("a") as file:
            begin = file.read(3)
            store.put("a", b"new" * 1000)
            assert begin + file.read() in (b"old" * 1000, b"new" * 1000)

    def test_missing_object_is_not_found_and_named(self, store: ObjectStore) -> None:
        for read in (store.get, store.open):
            with pytest.raises(NotFound) as caught:
                read("not/there")
            assert caught.value.code == "object_not_found"
            assert "not/there" in caught.value.detail
        with pytest.raises(NotFound) as caught:
            store.read_range("not/there", 0, 10)
        assert caught.value.code == "object_not_found"
        assert store.head("not/there") is None

    def test_keys_that_are_prefixes_of_others_are_independent(self, store: ObjectStore) -> None:
        """A store may reject them, or store them beside it."""
        store.put("a/b/c", b"there before")
        for key in ("a", "a/b", "a/b/c/d"):
            assert store.head(key) is None
            with pytest.raises(NotFound):
                store.get(key)
            store.delete(key)
        assert keys_of(store) == ["a/b/c"]
        for key in ("a", "a/b/c/d"):
            with contextlib.suppress(ValueError):
                store.put(key, b"and this one")
        assert store.get("a/b/c") == b"there before"

    def test_delete_removes_one_object_and_of_a_missing_one_is_no_error(
        self, store: ObjectStore
    ) -> None:
        store.put("a/b", b"x")
        store.put("a/bc", b"x")
        for _ in range(2):
            store.delete("a/b")
            assert keys_of(store) == ["a/bc"]
            with pytest.raises(NotFound):
                store.get("a/b")
        store.put("a/b", b"two")
        assert store.get("a/b") == b"two"

    def test_head_returns_size_and_time(self, store: ObjectStore) -> None:
        store.put("a/b", b"12345")
        info = store.head("a/b")
        assert info is not None
        assert (info.key, info.size_bytes) == ("a/b", 5)
        assert info.modified_at.utcoffset() == timedelta(0)
        # The store's clock may differ from this process's.
        assert abs(datetime.now(UTC) - info.modified_at) < timedelta(minutes=5)

    def test_list_gives_every_key_with_the_prefix(self, store: ObjectStore) -> None:
        keys = ["a/b/1", "a/b/2", "a/bc/3", "ab", "work/1/features-0.npy"]
        for key in keys:
            store.put(key, key.encode())
        for prefix in ("", "a", "a/", "a/b", "a/b/", "a/b/1", "a/b/1/", "work/1/feat", "not/"):
            assert keys_of(store, prefix) == [key for key in keys if key.startswith(prefix)]
        for info in store.list("a/"):
            assert info.size_bytes == len(info.key)
            assert info == store.head(info.key)

    def test_objects_may_be_deleted_while_they_are_listed(self, store: ObjectStore) -> None:
        for number in range(20):
            store.put(f"a/{number:02}", b"x")
        seen = []
        for info in store.list("a/"):
            seen.append(info.key)
            for number in range(20):
                store.delete(f"a/{number:02}")
        assert set(seen) <= {f"a/{number:02}" for number in range(20)}

    def test_odd_but_legal_keys_are_stored_unchanged(self, store: ObjectStore) -> None:
        for key in (
            *("with space/and+plus", "percent%2F%00", "question?and=hash#1", "quote'\"<>&"),
            *("üñí/日本", "..two-dots/three...dots", ".hidden/.file", "UPPER/lower", "x" * 200),
        ):
            store.put(key, b"odd")
            assert store.get(key) == b"odd"
            assert keys_of(store) == keys_of(store, key[:3]) == [key]
            store.delete(key)
            assert keys_of(store) == []
        store.put("a/B", b"upper")
        store.put("a/b", b"lower")
        assert (store.get("a/B"), store.get("a/b")) == (b"upper", b"lower")

    def test_check_of_a_working_store_leaves_no_object(self, store: ObjectStore) -> None:
        store.check()
        assert keys_of(store) == []

    def test_keys_that_could_leave_a_folder_or_alias_another_are_refused(
        self, store: ObjectStore
    ) -> None:
        for key in (
            *("", ".", "..", "../a", "a/../b", "a/..", "a/./b"),
            *("/etc/passwd", "a//b", "a/", "a\0b", "a\\b"),
        ):
            for use in (store.get, store.open, store.head, store.delete):
                with pytest.raises(ValueError):
                    use(key)
            with pytest.raises(ValueError):
                store.put(key, b"x")
            with pytest.raises(ValueError):
                store.read_range(key, 0, 10)
        assert keys_of(store) == []

    # --- of a store that belongs to one catalog ---

    def test_moved_object_has_its_new_key_alone_and_counts_as_written_now(
        self, store: OwnedStore
    ) -> None:
        store.put("originals/a", b"bytes")
        store.put("trash/2026-11-22/originals/a", b"of an earlier move")
        if isinstance(store, FolderStore):
            os.utime(store.path("originals/a"), (0, 0))
        store.move("originals/a", "trash/2026-11-22/originals/a")
        assert keys_of(store) == ["trash/2026-11-22/originals/a"]
        assert store.get("trash/2026-11-22/originals/a") == b"bytes"
        (info,) = store.list("trash/")
        assert datetime.now(UTC) - info.modified_at < timedelta(hours=1)
        store.move("trash/2026-11-22/originals/a", "originals/a")
        assert keys_of(store) == ["originals/a"]
        assert store.get("originals/a") == b"bytes"

    @pytest.mark.parametrize("key", ["originals/none", "chunks"])
    def test_missing_object_can_not_be_moved(self, store: OwnedStore, key: str) -> None:
        store.put("chunks/a", b"bytes")
        with pytest.raises(NotFound):
            store.move(key, "trash/2026-11-22/a")
        assert keys_of(store) == ["chunks/a"]

    @pytest.mark.parametrize("key", ["originals/a", "chunks/1/a.npy", "a"])
    def test_key_in_the_trash_is_listed_read_and_deleted_like_any_other(
        self, store: OwnedStore, key: str
    ) -> None:
        trashed = trash_key(key, date(2026, 11, 22))
        store.put(trashed, b"bytes")
        for prefix in ("", "trash/", "trash/2026-11-22/", trashed):
            assert keys_of(store, prefix) == [trashed]
        for prefix in ("originals/", "trash/2026-11-21/", "trash/2026-11-22/other"):
            assert keys_of(store, prefix) == []
        assert store.get(trashed) == b"bytes"
        store.delete(trashed)
        assert keys_of(store) == []

    def test_note_is_no_object_and_may_be_written_once_or_again(self, store: OwnedStore) -> None:
        assert store.read_note(".placewise-test") is None
        store.write_note(".placewise-test", b"one", replace=False)
        store.write_note(".placewise-test", b"two", replace=False)
        assert store.read_note(".placewise-test") == b"one"
        store.write_note(".placewise-test", b"three")
        assert store.read_note(".placewise-test") == b"three"
        assert not [key for key in keys_of(store) if not key.startswith(OWNER_MARK)]
        store.delete_note(".placewise-test")
        store.delete_note(".placewise-test")
        assert store.read_note(".placewise-test") is None
        for name in ("originals/a", ".placewise/a", "../.placewise"):
            with pytest.raises(ValueError):
                store.read_note(name)


class TestS3Store(ObjectStoreContract):
    """On a real server."""

    @pytest.fixture
    def store(self, s3: S3Server) -> S3Store:
        return S3Store(s3.new_bucket())

    def test_many_objects_are_listed_whole(self, store: S3Store) -> None:
        keys = [f"chunks/{number:04}" for number in range(1050)]  # a page has 1,000
        with ThreadPoolExecutor(8) as threads:
            list(threads.map(lambda key: store.put(key, b""), keys))
        assert keys_of(store, "chunks/") == keys


class TestS3StoreOnMoto(ObjectStoreContract):
    """On another one, which was written apart from the first. It takes every secret for the right
    one: no test but these runs on it."""

    @pytest.fixture
    def store(self, moto: S3Server) -> S3Store:
        return S3Store(moto.new_bucket())
