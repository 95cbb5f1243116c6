"""Cluster centres: what is read, and everything that is refused before it spoils a descriptor."""

from __future__ import annotations

import hashlib
import io
import pickle
import struct
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from shared.descriptors.vocabulary import decode_centres, encode_centres, parse_centres
from shared.errors import Unprocessable


def good_centres(clusters: int = 4, width: int = 6) -> NDArray[np.float32]:
    return np.random.default_rng(1).standard_normal((clusters, width)).astype(np.float32)


def npy(array: NDArray[Any]) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def npy_header(shape: str) -> bytes:
    """A `.npy` file that promises `shape` and holds four numbers."""
    text = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}"
    text += " " * (-(len(text) + 11) % 64) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode() + bytes(16)


def refusal(array: NDArray[Any]) -> str:
    with pytest.raises(Unprocessable) as caught:
        parse_centres(array)
    assert caught.value.code == "vocabulary_unusable"
    return caught.value.detail


def test_centres_survive_writing_and_reading() -> None:
    array = good_centres()
    checked = parse_centres(array)
    back = decode_centres(encode_centres(checked))
    np.testing.assert_array_equal(back.array, array)
    assert (back.clusters, back.dimension) == (4, 6)
    assert back.sha256 == checked.sha256 == hashlib.sha256(array.tobytes()).hexdigest()


@pytest.mark.parametrize("dtype", ["<f2", "<f8", ">f4"])
def test_other_floating_point_types_become_float32_and_order_changes_no_hash(dtype: str) -> None:
    array = good_centres()
    checked = parse_centres(array.astype(dtype))
    assert checked.array.dtype == np.float32
    np.testing.assert_allclose(checked.array, array, atol=2e-3)
    assert parse_centres(np.asfortranarray(array)).sha256 == parse_centres(array).sha256


def with_row(index: int, row: Any, dtype: str = "float32") -> NDArray[Any]:
    array = good_centres().astype(dtype)
    array[index] = row
    return array


@pytest.mark.parametrize(
    ("array", "reason"),
    [
        *((with_row(2, bad), "NaN or infinite") for bad in (np.nan, np.inf, -np.inf)),
        (with_row(0, 1e300, "float64"), "NaN or infinite"),
        (with_row(2, 0), "centre 2 is zero"),
        (with_row(3, good_centres()[0]), "only 3 of its 4 centres are distinct"),
        (good_centres(4097), "it has 4097 centres, more than 4096"),
        *((np.ones(shape), "its shape is") for shape in ((), (6,), (2, 3, 4), (0, 6), (4, 0))),
        *((good_centres().astype(dtype), "not floating point") for dtype in ("i8", "c8", "S4")),
    ],
)
def test_centres_with_invalid_values_are_refused(array: NDArray[Any], reason: str) -> None:
    assert reason in refusal(array)


@pytest.mark.parametrize("factor", [3e38, 1e7])
def test_centres_whose_residuals_may_overflow_are_refused(factor: float) -> None:
    array = good_centres()
    array[2] = factor
    assert "the norm of centre 2 is" in refusal(array)
    array[2] = 1e4
    assert parse_centres(array).clusters == len(array)


class Untrustworthy:
    """Unpickling this would be noticed."""

    unpickled = False

    def __reduce__(self) -> tuple[Any, ...]:
        return _notice, ()


def _notice() -> None:
    Untrustworthy.unpickled = True


def junk_files() -> dict[str, bytes]:
    npz = io.BytesIO()
    np.savez(npz, centres=good_centres())
    return {
        "nothing": b"",
        "text": b"these are not centres",
        "an archive": npz.getvalue(),
        "the beginning of an archive": b"PK\x03\x04 and no more",
        "a truncated array": npy(good_centres())[:-7],
        "a broken header": b"\x93NUMPY\x01\x00\x10\x00((((((((((((((((",
        "an unknown version": b"\x93NUMPY\x09\x00",
        "objects": npy(np.array([[Untrustworthy()]], dtype=object)),
        "a bare pickle": pickle.dumps(Untrustworthy()),
        "more rows than memory": npy_header("(10000000000000, 112)"),
        "more rows than numbers": npy_header("(10000000000000000000000000000, 2)"),
        "a negative shape": npy_header("(-1, 2)"),
        "a shape of truth values": npy_header("(True, 4)"),
    }


@pytest.mark.parametrize("name", junk_files())
def test_files_that_are_no_array_are_refused(name: str) -> None:
    with pytest.raises(Unprocessable) as caught:
        decode_centres(junk_files()[name])
    assert caught.value.code == "vocabulary_unusable"
    assert not Untrustworthy.unpickled
