"""The files of a chunk's codes.

One line of JSON that says what follows and of which rows it is, filled up with blanks to a
multiple of 64 bytes; then the arrays, little endian, each beginning at a multiple of 64. So they
can be used where they lie in a mapped file.

* Sign codes, `<chunk>.codes`: float32 norms and each level's words. `shared.storage.chunks`
writes it
  beside the rows.
* Int8 codes: float32 scales, errors and lengths, and the bytes. Who searches by them makes them
  (`services.search.chunk_loader`): they are as large as a quarter of the rows, and made in a
  fraction of
  the time that the rows took.

Either can always be made again from the rows: a reader that finds none, or one that is made
otherwise, does so.
"""

from __future__ import annotations

import hashlib
import json
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared.codes.int8_codes import Int8Codes, int8_codes
from shared.codes.rotation import ROUNDS, SEED, Floats, get_rotation
from shared.codes.sign_codes import SignCodes, encode_signs, level_words

SIGN_CODES_FORMAT = 1
INT8_CODES_FORMAT = 1
ALIGNMENT_BYTES = 64
MAX_HEADER_BYTES = 4096

Layout = tuple[str, tuple[int, ...]]
"""The dtype of an array, and the shape of what it has for each row."""


def encode_sign_codes(rows: Floats, chunk_sha256: str) -> bytes:
    """The file of the sign codes of (n, dimension) rows, whose chunk has this hash."""
    codes = encode_signs(rows)
    return _encode(_sign_codes_spec(rows.shape[1]), [codes.norms, *codes.levels], chunk_sha256)


def decode_sign_codes(data: Any, *, rows: int, dimension: int, chunk_sha256: str) -> SignCodes:
    """The sign codes in a file's bytes, or in any buffer of them, which they go on using.

    ValueError says why they are not those of this chunk, as they are made now.
    """
    made = _sign_codes_spec(dimension)
    layout: list[Layout] = [("<f4", ()), *(("<u8", (words,)) for words in made["levels"])]
    norms, *levels = _decode(data, made, layout, rows, chunk_sha256)
    return SignCodes(tuple(levels), norms)


def encode_int8_codes(rows: Floats, chunk_sha256: str) -> bytes:
    """The file of the int8 codes of (n, dimension) rows, whose chunk has this hash."""
    codes = int8_codes(rows)
    arrays: list[NDArray[Any]] = [codes.scales, codes.errors, codes.lengths, codes.numbers]
    return _encode(_int8_codes_spec(rows.shape[1]), arrays, chunk_sha256)


def decode_int8_codes(data: Any, *, rows: int, dimension: int, chunk_sha256: str) -> Int8Codes:
    """The int8 codes in a file's bytes, as `decode_sign_codes` reads sign codes."""
    single: Layout = ("<f4", ())
    layout: list[Layout] = [single, single, single, ("|i1", (get_rotation(dimension).padded,))]
    arrays = _decode(data, _int8_codes_spec(dimension), layout, rows, chunk_sha256)
    scales, errors, lengths, numbers = arrays
    return Int8Codes(numbers, scales, errors, lengths)


def _sign_codes_spec(dimension: int) -> dict[str, Any]:
    """How sign codes are made: others are not compared with them."""
    return {
        "format": SIGN_CODES_FORMAT,
        "dimension": dimension,
        "seed": SEED,
        "rounds": ROUNDS,
        "levels": list(level_words(get_rotation(dimension).padded)),
    }


def _int8_codes_spec(dimension: int) -> dict[str, Any]:
    return {
        "format": INT8_CODES_FORMAT,
        "kind": "int8",
        "dimension": dimension,
        "seed": SEED,
        "rounds": ROUNDS,
    }


def _encode(made: dict[str, Any], arrays: list[NDArray[Any]], chunk_sha256: str) -> bytes:
    pieces = [_padded(np.ascontiguousarray(array).tobytes()) for array in arrays]
    digest = hashlib.sha256()
    for piece in pieces:
        digest.update(piece)
    header = {
        **made,
        "rows": len(arrays[0]),
        "chunk_sha256": chunk_sha256,
        "sha256": digest.hexdigest(),
    }
    return b"".join([_padded(json.dumps(header).encode(), b" ", end=b"\n"), *pieces])


def _decode(
    data: Any, made: dict[str, Any], layout: list[Layout], rows: int, chunk_sha256: str
) -> list[NDArray[Any]]:
    """The arrays of a file that was made so; ValueError when it is another."""
    view = memoryview(data)
    line, _, _ = bytes(view[:MAX_HEADER_BYTES]).partition(b"\n")
    header = json.loads(line)  # a JSONDecodeError is a ValueError
    if not isinstance(header, dict):
        raise ValueError("no codes: the file begins otherwise")
    expected = {**made, "rows": rows, "chunk_sha256": chunk_sha256}
    wrong = [name for name, value in expected.items() if header.get(name) != value]
    if wrong:
        raise ValueError(f"codes of other rows, or made otherwise: {', '.join(wrong)}")
    body = view[len(line) + 1 :]
    if hashlib.sha256(body).hexdigest() != header.get("sha256"):
        raise ValueError("the codes are not what was written: their hash differs")
    arrays, at = [], 0
    for dtype, shape in layout:
        array, at = _array(body, at, dtype, (rows, *shape))
        arrays.append(array)
    return arrays


def _array(
    body: memoryview, at: int, dtype: str, shape: tuple[int, ...]
) -> tuple[NDArray[Any], int]:
    """The array that begins there, and where the next one does."""
    array = np.frombuffer(body, dtype, math.prod(shape), at).reshape(shape)
    return array, at + -(-array.nbytes // ALIGNMENT_BYTES) * ALIGNMENT_BYTES


def _padded(data: bytes, filling: bytes = b"\0", end: bytes = b"") -> bytes:
    missing = -(len(data) + len(end)) % ALIGNMENT_BYTES
    return data + filling * missing + end
