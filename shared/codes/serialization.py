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
from typing import Any

import numpy as np

from shared.codes.rotation import ROUNDS, SEED, StoredFloats, get_rotation
from shared.codes.sign_codes import SignCodes, encode_signs, level_words

SIGN_CODES_FORMAT = 1
ALIGNMENT_BYTES = 64
MAX_HEADER_BYTES = 4096


def encode_sign_codes(rows: StoredFloats, chunk_sha256: str) -> bytes:
    """Encode the sign codes of (n, dimension) rows of the chunk with this hash."""
    codes = encode_signs(rows)
    arrays = (codes.norms, *codes.levels)
    body = b"".join(_padded(np.ascontiguousarray(array).tobytes()) for array in arrays)
    header = {
        **_parameters(len(rows), rows.shape[1], chunk_sha256),
        "sha256": hashlib.sha256(body).hexdigest(),
    }
    return _padded(json.dumps(header).encode(), b" ", end=b"\n") + body


def decode_sign_codes(data: Any, *, rows: int, dimension: int, chunk_sha256: str) -> SignCodes:
    """Decode sign codes from the bytes of a file, or from any buffer, without copying them.

    Args:
        data: The buffer, which the codes refer to.

    Raises:
        ValueError: The codes belong to another chunk, have other parameters, or are damaged.
    """
    view = memoryview(data)
    line, _, _ = bytes(view[:MAX_HEADER_BYTES]).partition(b"\n")
    header = json.loads(line)  # a JSONDecodeError is a ValueError
    if not isinstance(header, dict):
        raise ValueError("not a file of codes: its header is not a JSON object")
    expected = _parameters(rows, dimension, chunk_sha256)
    mismatched = [name for name, value in expected.items() if header.get(name) != value]
    if mismatched:
        raise ValueError(f"codes of other rows or parameters: {', '.join(mismatched)} differ")
    body = view[len(line) + 1 :]
    if hashlib.sha256(body).hexdigest() != header.get("sha256"):
        raise ValueError("the codes are corrupt: their hash differs")
    norms = np.frombuffer(body, "<f4", rows)
    offset, levels = _aligned(norms.nbytes), []
    for words in expected["levels"]:
        level = np.frombuffer(body, "<u8", rows * words, offset).reshape(rows, words)
        offset += _aligned(level.nbytes)
        levels.append(level)
    return SignCodes(tuple(levels), norms)


def _parameters(rows: int, dimension: int, chunk_sha256: str) -> dict[str, Any]:
    """What codes and rows must agree in; codes with other parameters can't be compared."""
    return {
        "format": SIGN_CODES_FORMAT,
        "dimension": dimension,
        "seed": SEED,
        "rounds": ROUNDS,
        "levels": list(level_words(get_rotation(dimension).padded)),
        "rows": rows,
        "chunk_sha256": chunk_sha256,
    }


def _aligned(size_bytes: int) -> int:
    return -(-size_bytes // ALIGNMENT_BYTES) * ALIGNMENT_BYTES


def _padded(data: bytes, filling: bytes = b"\0", end: bytes = b"") -> bytes:
    size = len(data) + len(end)
    return data + filling * (_aligned(size) - size) + end
