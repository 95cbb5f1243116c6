"""File format of codes, for memory mapping.

A file begins with one line of JSON that describes the arrays and the rows that they belong to,
padded with blanks to a multiple of 64 bytes. The arrays follow, little-endian, each aligned to 64
bytes, so that they can be used in a memory-mapped file.

Sign codes, `<chunk>.codes`, are float32 norms and the words of each level. `shared.storage.chunks`
writes them beside the rows.

Codes can always be computed again from the rows, and a reader does so if the file is missing or was
written with other parameters.
"""

from __future__ import annotations

import hashlib
import json
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared.codes.rotation import ROUNDS, SEED, StoredFloats, get_rotation
from shared.codes.sign_codes import SignCodes, encode_signs, level_words

SIGN_CODES_FORMAT = 1
ALIGNMENT_BYTES = 64
MAX_HEADER_BYTES = 4096

Layout = tuple[str, tuple[int, ...]]
"""Dtype of an array, and the shape of its entry for one row."""


def encode_sign_codes(rows: StoredFloats, chunk_sha256: str) -> bytes:
    """Encode the sign codes of (n, dimension) rows of the chunk with this hash."""
    codes = encode_signs(rows)
    return _encode(_sign_codes_spec(rows.shape[1]), [codes.norms, *codes.levels], chunk_sha256)


def decode_sign_codes(data: Any, *, rows: int, dimension: int, chunk_sha256: str) -> SignCodes:
    """Decode sign codes from the bytes of a file, or from any buffer, without copying them.

    Args:
        data: The buffer, which the codes refer to.
        rows: Number of rows of the chunk.
        dimension: Dimension of the rows.
        chunk_sha256: Hash of the chunk.

    Raises:
        ValueError: The codes belong to another chunk, have other parameters, or are damaged.
    """
    spec = _sign_codes_spec(dimension)
    layout: list[Layout] = [("<f4", ()), *(("<u8", (words,)) for words in spec["levels"])]
    norms, *levels = _decode(data, spec, layout, rows, chunk_sha256)
    return SignCodes(tuple(levels), norms)


def _sign_codes_spec(dimension: int) -> dict[str, Any]:
    """Parameters of sign codes; codes with different parameters can't be compared."""
    return {
        "format": SIGN_CODES_FORMAT,
        "dimension": dimension,
        "seed": SEED,
        "rounds": ROUNDS,
        "levels": list(level_words(get_rotation(dimension).padded)),
    }


def _encode(spec: dict[str, Any], arrays: list[NDArray[Any]], chunk_sha256: str) -> bytes:
    blocks = [_padded(np.ascontiguousarray(array).tobytes()) for array in arrays]
    digest = hashlib.sha256()
    for block in blocks:
        digest.update(block)
    header = {
        **spec,
        "rows": len(arrays[0]),
        "chunk_sha256": chunk_sha256,
        "sha256": digest.hexdigest(),
    }
    return b"".join([_padded(json.dumps(header).encode(), b" ", end=b"\n"), *blocks])


def _decode(
    data: Any, spec: dict[str, Any], layout: list[Layout], rows: int, chunk_sha256: str
) -> list[NDArray[Any]]:
    """Return the arrays of a file; ValueError if its parameters, chunk or hash differ."""
    view = memoryview(data)
    line, _, _ = bytes(view[:MAX_HEADER_BYTES]).partition(b"\n")
    header = json.loads(line)  # a JSONDecodeError is a ValueError
    if not isinstance(header, dict):
        raise ValueError("not a file of codes: its header is not a JSON object")
    expected = {**spec, "rows": rows, "chunk_sha256": chunk_sha256}
    mismatched = [name for name, value in expected.items() if header.get(name) != value]
    if mismatched:
        raise ValueError(f"codes of other rows or parameters: {', '.join(mismatched)} differ")
    body = view[len(line) + 1 :]
    if hashlib.sha256(body).hexdigest() != header.get("sha256"):
        raise ValueError("the codes are corrupt: their hash differs")
    arrays, offset = [], 0
    for dtype, shape in layout:
        array, offset = _array(body, offset, dtype, (rows, *shape))
        arrays.append(array)
    return arrays


def _array(
    body: memoryview, offset: int, dtype: str, shape: tuple[int, ...]
) -> tuple[NDArray[Any], int]:
    """Return the array at the offset, and the offset of the next one."""
    array = np.frombuffer(body, dtype, math.prod(shape), offset).reshape(shape)
    return array, offset + -(-array.nbytes // ALIGNMENT_BYTES) * ALIGNMENT_BYTES


def _padded(data: bytes, filling: bytes = b"\0", end: bytes = b"") -> bytes:
    padding = -(len(data) + len(end)) % ALIGNMENT_BYTES
    return data + filling * padding + end
