"""The chunk format: what is written is what is read, and anything else is noticed."""

from __future__ import annotations

import hashlib
import io
import json
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, BinaryIO, cast
from uuid import UUID

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from shared.errors import NotFound, Unavailable
from shared.ids import new_id
from shared.storage import FolderStore
from shared.storage.chunks import (
    HEADER_READ_BYTES,
    WrittenChunk,
    chunk_key,
    decode_rows,
    delete_chunk,
    encode_rows,
    features_key,
    manifest_key,
    read_chunk,
    read_row,
    rows_are_valid,
    write_chunk,
)
from shared.storage.feature_files import FeatureRows, read_feature_index, read_feature_rows

GENERATION, CHUNK = new_id(), new_id()


def some_rows(count: int = 5, dimension: int = 7) -> NDArray[np.float32]:
    return np.random.default_rng(count).standard_normal((count, dimension)).astype(np.float32)


def written(
    store: FolderStore,
    rows: NDArray[Any],
    photo_ids: list[UUID],
    features: FeatureRows | None = None,
) -> WrittenChunk:
    return write_chunk(
        store,
        generation_id=GENERATION,
        chunk_id=CHUNK,
        rows=rows,
        photo_ids=photo_ids,
        spec={"extractor": "test", "dimension": rows.shape[1]},
        features=features,
    )


@given(
    count=st.integers(0, 6),
    dimension=st.integers(1, 9),
    order=st.sampled_from(["C", "F"]),
    data=st.data(),
)
def test_any_float32_rows_survive_encoding(
    count: int, dimension: int, order: Any, data: st.DataObject
) -> None:
    bits = data.draw(st.binary(min_size=4 * count * dimension, max_size=4 * count * dimension))
    rows = np.asarray(np.frombuffer(bits, dtype=np.float32).reshape(count, dimension), order=order)
    back = decode_rows(encode_rows(rows))
    assert back.shape == rows.shape
    assert back.tobytes() == rows.tobytes("C"), "every bit, NaNs too"


def test_file_is_a_plain_npy_file_that_numpy_itself_reads(store: FolderStore) -> None:
    rows = some_rows()
    chunk = written(store, rows, [new_id() for _ in rows])
    data = store.get(chunk.object_key)
    np.testing.assert_array_equal(np.load(io.BytesIO(data), allow_pickle=False), rows)
    assert chunk.size_bytes == len(data)
    assert chunk.sha256 == hashlib.sha256(data).hexdigest()
    assert chunk.object_key == chunk_key(GENERATION, CHUNK)


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_rows_come_back_as_they_were_written_and_single_ones_as_float32(
    store: FolderStore, dtype: Any
) -> None:
    rows = some_rows().astype(dtype)
    chunk = written(store, rows, [new_id() for _ in rows])
    back = read_chunk(store, chunk.object_key, chunk.sha256)
    np.testing.assert_array_equal(back, rows)
    assert back.dtype == dtype
    assert not back.flags.writeable
    row = read_row(store, chunk.object_key, 3)
    np.testing.assert_array_equal(row, rows[3])
    assert row.dtype == np.float32


def test_other_arrays_are_refused_when_written_and_when_read() -> None:
    rows = some_rows()
    others: list[NDArray[Any]] = [rows[0], rows[None]]
    others += [rows.astype(dtype) for dtype in (np.float64, np.int32, ">f4", ">f2")]
    for other in others:
        with pytest.raises(ValueError, match="2-D float32"):
            encode_rows(other)
        buffer = io.BytesIO()
        np.save(buffer, other)
        with pytest.raises(ValueError, match="not a chunk"):
            decode_rows(buffer.getvalue())
    buffer = io.BytesIO()
    np.save(buffer, np.asfortranarray(rows))
    with pytest.raises(ValueError, match="fortran_order=True"):
        decode_rows(buffer.getvalue())
    for cut in (0, 5, 60, -1, -4):
        with pytest.raises(ValueError):
            decode_rows(encode_rows(rows)[:cut])


def test_chunk_with_a_flipped_bit_is_unavailable_and_a_missing_one_is_not_found(
    store: FolderStore,
) -> None:
    rows = some_rows()
    chunk = written(store, rows, [new_id() for _ in rows])
    data = bytearray(store.get(chunk.object_key))
    data[-3] ^= 1
    store.put(chunk.object_key, bytes(data))
    with pytest.raises(Unavailable) as caught:
        read_chunk(store, chunk.object_key, chunk.sha256)
    assert caught.value.code == "chunk_corrupt"
    assert caught.value.extra["object_key"] == chunk.object_key
    store.delete(chunk.object_key)
    with pytest.raises(NotFound):
        read_chunk(store, chunk.object_key, chunk.sha256)


def test_manifest_maps_rows_to_photos_and_is_written_before_its_chunk(
    store: FolderStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    put, order = store.put, []

    def noted(key: str, data: bytes) -> None:
        order.append(key)
        put(key, data)

    monkeypatch.setattr(store, "put", noted)
    rows = some_rows()
    photo_ids = [new_id() for _ in rows][::-1]
    chunk = written(store, rows, photo_ids)
    assert order == [manifest_key(chunk.object_key), chunk.object_key]
    manifest = json.loads(store.get(manifest_key(chunk.object_key)))
    assert manifest["photo_ids"] == [str(photo_id) for photo_id in photo_ids]
    assert manifest["sha256"] == chunk.sha256
    assert manifest["generation_id"] == str(GENERATION)
    assert manifest["chunk_id"] == str(CHUNK)
    assert (manifest["rows"], manifest["dimension"]) == (5, 7)
    assert manifest["spec"] == {"extractor": "test", "dimension": 7}


def test_local_features_come_back_by_row_and_stand_in_the_manifest(store: FolderStore) -> None:
    rows = some_rows(3)
    stored = [b"first", b"", b"third"]
    chunk = written(store, rows, [new_id() for _ in rows], FeatureRows("test@1", stored))
    key = features_key(chunk.object_key)
    data = store.get(key)
    assert (chunk.features_model, chunk.features_rows) == ("test@1", 2)
    assert chunk.features_bytes == len(data)
    assert chunk.features_sha256 == hashlib.sha256(data).hexdigest()
    index = read_feature_index(store, key)
    assert (index.model, index.rows) == ("test@1", 3)
    assert read_feature_rows(store, key, index, [2, 1, 0, 9]) == {0: b"first", 2: b"third"}
    manifest = json.loads(store.get(manifest_key(chunk.object_key)))
    assert manifest["features"] == {
        "model": "test@1",
        "rows": 2,
        "size_bytes": len(data),
        "sha256": chunk.features_sha256,
    }
    delete_chunk(store, chunk.object_key)
    assert list(store.list("")) == []


def test_chunk_whose_photos_have_no_local_features_has_no_file_of_them(store: FolderStore) -> None:
    chunk = written(store, some_rows(2), [new_id(), new_id()], FeatureRows("test@1", [b"", b""]))
    assert (chunk.features_model, chunk.features_rows, chunk.features_bytes) == (None, 0, 0)
    assert not store.head(features_key(chunk.object_key))


def test_every_row_needs_its_photo(store: FolderStore) -> None:
    with pytest.raises(ValueError, match="5 rows for 4 photos"):
        written(store, some_rows(), [new_id() for _ in range(4)])
    assert list(store.list("")) == []


class CountingStore(FolderStore):
    """Counts the bytes that are read."""

    bytes_read = 0

    def open(self, key: str) -> BinaryIO:
        store, opened = self, super().open(key)

        class Counted(io.RawIOBase):
            def readable(self) -> bool:
                return True

            def read(self, size: int = -1) -> bytes:
                data = opened.read(min(size, 700))  # less than requested, as from a network
                store.bytes_read += len(data)
                return data

            def seek(self, offset: int, whence: int = 0) -> int:
                return opened.seek(offset, whence)

            def close(self) -> None:
                opened.close()
                super().close()

        return cast(BinaryIO, Counted())


def test_one_row_is_read_without_the_others(tmp_path: Path) -> None:
    store = CountingStore(tmp_path)
    rows = some_rows(40, 5000)
    chunk = written(store, rows, [new_id() for _ in rows])
    for row in (0, 17, 39):
        store.bytes_read = 0
        np.testing.assert_array_equal(read_row(store, chunk.object_key, row), rows[row])
        assert store.bytes_read == HEADER_READ_BYTES + rows[row].nbytes
    with pytest.raises(IndexError):
        read_row(store, chunk.object_key, 40)


@pytest.mark.parametrize("damage", ["cut", "other"])
def test_a_row_of_a_damaged_object_is_an_error(store: FolderStore, damage: str) -> None:
    rows = some_rows()
    chunk = written(store, rows, [new_id() for _ in rows])
    whole = store.get(chunk.object_key)
    store.put(chunk.object_key, whole[:-5] if damage == "cut" else b"something else")
    with pytest.raises(ValueError):
        read_row(store, chunk.object_key, 4)
    with pytest.raises(NotFound):
        read_row(store, "chunks/no/such.npy", 0)


def test_headers_are_parsed_by_one_thread_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    parse, parsing, most = np.lib.format.read_array_header_1_0, set[int](), 0

    def parse_slowly(file: BinaryIO) -> Any:
        nonlocal most
        parsing.add(id(file))
        most = max(most, len(parsing))
        time.sleep(0.01)
        parsing.remove(id(file))
        return parse(file)

    monkeypatch.setattr(np.lib.format, "read_array_header_1_0", parse_slowly)
    rows = some_rows()
    with ThreadPoolExecutor(4) as threads:
        for decoded in threads.map(decode_rows, [encode_rows(rows)] * 8):
            np.testing.assert_array_equal(decoded, rows)
    assert most == 1


def test_row_is_whole_with_the_length_of_a_descriptor_and_damaged_with_any_other() -> None:
    direction = np.full(4, 0.5)
    lengths = [1, 0, 1.0009, 0.9991, 1.0011, 0.5, np.nan, np.inf]
    rows = np.stack([direction * length for length in lengths]).astype(np.float32)
    assert rows_are_valid(rows).tolist() == [True, True, True, True, False, False, False, False]


def test_norms_of_float16_rows_are_summed_more_precisely_than_they_are_stored() -> None:
    rows = some_rows(2, 98_304)
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    assert rows_are_valid(rows.astype(np.float16)).all()


def test_the_local_features_of_another_chunk_are_recognised(store: FolderStore) -> None:
    features = FeatureRows("test@1", [b"first", b"second"])
    mine, other = (
        write_chunk(
            store,
            generation_id=GENERATION,
            chunk_id=new_id(),
            rows=some_rows(2),
            photo_ids=[new_id(), new_id()],
            spec={},
            features=features,
        )
        for _ in range(2)
    )
    store.put(features_key(mine.object_key), store.get(features_key(other.object_key)))
    with pytest.raises(ValueError, match=features_key(other.object_key).rpartition("/")[2]):
        read_feature_index(store, features_key(mine.object_key))
    assert read_feature_index(store, features_key(other.object_key)).rows == 2
