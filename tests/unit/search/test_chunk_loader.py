"""Chunks as files of this machine: fetched once, checked, mapped; codes beside them or made."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO
from uuid import UUID

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import shared.codes.serialization
from services.search.chunk_loader import (
    ChunkLoader,
    LoadedChunk,
    MemoryBudget,
    StoredChunk,
    allocate_parts,
    hold_in_memory,
    list_generation_folders,
    memory_parts,
    remove_stale_folders,
)
from services.search.photo_columns import PhotoColumns
from shared.catalog.chunks import Chunk
from shared.codes.sign_codes import encode_signs
from shared.errors import Unavailable
from shared.ids import new_id
from shared.storage import FolderStore
from shared.storage.chunks import CODED_BYTES, codes_key, delete_chunk, write_chunk

DIMENSION = 7168
MANY = CODED_BYTES // (4 * DIMENSION) + 1

Rows = NDArray[np.float32]


class Bucket(FolderStore):
    """Objects that are no files of this machine; counts how often one is opened."""

    opened = 0

    def file(self, key: str) -> Path | None:
        return None

    def open(self, key: str) -> BinaryIO:
        self.opened += 1
        return super().open(key)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "cache" / "generation"


@pytest.fixture(params=["folder", "bucket"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> FolderStore:
    kind = FolderStore if request.param == "folder" else Bucket
    return kind(tmp_path / "objects")


def unit_rows(count: int) -> Rows:
    rows = np.random.default_rng(count).standard_normal((count, DIMENSION), np.float32)
    found: Rows = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    return found


def written(store: FolderStore, rows: Rows) -> Chunk:
    generation_id, chunk_id = new_id(), new_id()
    chunk = write_chunk(
        store,
        generation_id=generation_id,
        chunk_id=chunk_id,
        rows=rows,
        photo_ids=[new_id() for _ in rows],
        spec={},
    )
    return Chunk(
        id=chunk_id,
        generation_id=generation_id,
        object_key=chunk.object_key,
        rows=chunk.rows,
        sha256=chunk.sha256,
    )


def test_rows_are_those_that_were_written_also_when_the_object_and_its_copy_are_deleted(
    store: FolderStore, folder: Path
) -> None:
    rows = unit_rows(5)
    chunk = written(store, rows)
    loader = ChunkLoader(store, folder)
    stored = loader.load_rows(chunk)
    assert not stored.rows.flags.writeable
    stored.file.prefetch(5000, 100_000)
    delete_chunk(store, chunk.object_key)
    loader.evict_except([])
    np.testing.assert_array_equal(stored.rows, rows)


def test_objects_of_a_bucket_are_fetched_once_and_files_of_a_folder_are_not_copied(
    tmp_path: Path, folder: Path
) -> None:
    files = FolderStore(tmp_path / "files")
    ChunkLoader(files, folder).load_rows(written(files, unit_rows(5)))
    assert not folder.exists()
    bucket = Bucket(tmp_path / "objects")
    chunk = written(bucket, unit_rows(5))
    for _ in range(3):
        ChunkLoader(bucket, folder).load_rows(chunk)
    assert bucket.opened == 1


@pytest.mark.parametrize("damage", [lambda data: data[:-7], lambda data: data[:-1] + b"?"])
def test_damaged_chunk_is_refused_by_its_hash_and_served_once_it_is_repaired(
    store: FolderStore, folder: Path, damage: Callable[[bytes], bytes]
) -> None:
    chunk = written(store, unit_rows(5))
    whole = store.get(chunk.object_key)
    store.put(chunk.object_key, damage(whole))
    loader = ChunkLoader(store, folder)
    with pytest.raises(Unavailable) as caught:
        loader.load_rows(chunk)
    assert caught.value.code == "chunk_corrupt"
    assert chunk.object_key in caught.value.detail
    assert not list(folder.glob("*"))
    store.put(chunk.object_key, whole)
    assert len(loader.load_rows(chunk).rows) == 5


@pytest.mark.parametrize("damage", [b"", b"x" * 1000], ids=["empty", "other bytes"])
def test_a_damaged_copy_in_the_cache_is_fetched_again(
    tmp_path: Path, folder: Path, damage: bytes
) -> None:
    bucket = Bucket(tmp_path / "objects")
    rows = unit_rows(3)
    chunk = written(bucket, rows)
    (folder / f"{chunk.sha256}.npy").parent.mkdir(parents=True)
    (folder / f"{chunk.sha256}.npy").write_bytes(damage)
    assert np.array_equal(ChunkLoader(bucket, folder).load_rows(chunk).rows, rows)
    assert np.array_equal(ChunkLoader(bucket, folder).load_rows(chunk).rows, rows)
    assert bucket.opened == 1


def test_only_the_files_of_chunks_that_are_searched_are_kept(tmp_path: Path, folder: Path) -> None:
    store = Bucket(tmp_path / "objects")
    loader = ChunkLoader(store, folder)
    retained, dropped = (loader.load_rows(written(store, unit_rows(n))) for n in (3, 4))
    (folder / "old.partial").touch()
    long_ago = time.time() - 7200
    os.utime(folder / "old.partial", (long_ago, long_ago))
    (folder / "new.partial").touch()
    loader.evict_except([loaded(retained)])
    assert {path.name for path in folder.iterdir()} == {f"{retained.sha256}.npy", "new.partial"}
    assert len(dropped.rows) == 4
    other = folder.with_name(str(new_id()))
    other.mkdir()
    mine = new_id()
    folder.rename(folder.with_name(str(mine)))
    remove_stale_folders(list_generation_folders(folder.parent), [mine])
    assert [path.name for path in folder.parent.iterdir()] == [str(mine)]


def loaded(stored: StoredChunk) -> LoadedChunk:
    photos = PhotoColumns.of(len(stored.rows), [])
    return LoadedChunk(new_id(), "chunks/a.npy", stored.rows, photos, stored.codes, stored)


def test_sign_codes_are_stored_beside_long_chunks_only(store: FolderStore) -> None:
    long, short = written(store, unit_rows(MANY)), written(store, unit_rows(MANY - 2))
    assert store.head(codes_key(long.object_key)) is not None
    assert store.head(codes_key(short.object_key)) is None
    for chunk in (long, short):
        delete_chunk(store, chunk.object_key)
    assert list(store.list("")) == [], "manifests and codes go with their chunks"
    delete_chunk(store, long.object_key)


def test_stored_sign_codes_are_not_computed_again(
    store: FolderStore, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = unit_rows(MANY)
    chunk = written(store, rows)
    monkeypatch.delattr(shared.codes.serialization, "encode_signs")
    loader = ChunkLoader(store, folder)
    codes = loader.load_sign_codes(chunk.object_key, loader.load_rows(chunk))
    for level, expected in zip(codes.levels, encode_signs(rows).levels, strict=True):
        np.testing.assert_array_equal(level, expected)


def test_missing_sign_codes_are_computed_once(
    store: FolderStore, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = unit_rows(6)
    chunk = written(store, rows)
    for _ in range(2):
        loader = ChunkLoader(store, folder)
        codes = loader.load_sign_codes(chunk.object_key, loader.load_rows(chunk))
        np.testing.assert_array_equal(codes.levels[0], encode_signs(rows).levels[0])
        monkeypatch.delattr(shared.codes.serialization, "encode_signs", raising=False)


def test_damaged_sign_codes_are_computed_again(store: FolderStore, folder: Path) -> None:
    rows = unit_rows(MANY)
    chunk = written(store, rows)
    key = codes_key(chunk.object_key)
    store.put(key, store.get(key)[:-1] + b"?")
    loader = ChunkLoader(store, folder)
    codes = loader.load_sign_codes(chunk.object_key, loader.load_rows(chunk))
    np.testing.assert_array_equal(codes.levels[-1], encode_signs(rows).levels[-1])


def test_codes_and_rows_are_equal_in_memory_and_mapped(store: FolderStore, folder: Path) -> None:
    rows = unit_rows(6)
    chunk = written(store, rows)
    loader = ChunkLoader(store, folder)
    stored = loader.load_rows(chunk)
    codes = loader.load_sign_codes(chunk.object_key, stored)
    stored = StoredChunk(stored.file, stored.rows, stored.sha256, codes)
    one = loaded(stored)
    assert memory_parts([one, one]) == [2 * 6 * 896, 2 * 6 * 4 * DIMENSION]
    for parts in (0, 1, 2, 1, 0):
        one = hold_in_memory(one, parts)
        assert one.codes is not None
        assert (one.codes.levels[0] is codes.levels[0]) == (parts < 1)
        assert (one.rows is stored.rows) == (parts < 2)
        np.testing.assert_array_equal(one.rows, rows)
        np.testing.assert_array_equal(one.codes.levels[0], codes.levels[0])
        one.prefetch_row(5)
    again = hold_in_memory(hold_in_memory(one, 2), 2)
    assert hold_in_memory(again, 2).rows is again.rows, "what is in memory is not copied again"


@given(
    sizes=st.dictionaries(st.uuids(), st.lists(st.integers(0, 50), max_size=4), max_size=4),
    budget=st.integers(0, 300),
)
def test_memory_budget_is_used_and_not_exceeded(sizes: dict[UUID, list[int]], budget: int) -> None:
    counts = allocate_parts(sizes, budget)
    left = budget - sum(sum(sizes[key][:count]) for key, count in counts.items())
    assert left >= 0
    for key, count in counts.items():
        assert count == len(sizes[key]) or sizes[key][count] > left


def test_first_parts_of_all_generations_are_held_before_any_second_part() -> None:
    first, second = new_id(), new_id()
    assert allocate_parts({first: [10, 50], second: [10, 5]}, 60) == {first: 1, second: 2}
    assert allocate_parts({first: [10, 40], second: [10, 5]}, 60) == {first: 2, second: 1}


def test_unloading_a_generation_frees_its_memory_budget() -> None:
    memory = MemoryBudget(100)
    first, second = new_id(), new_id()
    assert memory.allocate(first, [60, 30]) == 2
    assert memory.allocate(second, [60]) == 0
    memory.release_generation(first)
    assert memory.allocate(second, [60]) == 1
