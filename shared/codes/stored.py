"""The file of a chunk's codes: `<chunk>.codes`, beside its rows.

One line of JSON that says what follows and of which rows it is, filled up with blanks to a
multiple of 64 bytes; then float32 norms and each level's words, little endian, each beginning at a
multiple of 64. So the arrays can be used where they lie in a mapped file.

`shared.chunks` writes it with the rows. It can always be made again from them: a reader that finds
none, or one that is made otherwise, does so.
"""

from __future__ import annotations

import hashlib
import json
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared.codes.rotation import ROUNDS, SEED, Floats, rotation
from shared.codes.signs import SignCodes, level_words, sign_codes

FORMAT = 1
ALIGNED = 64
MOST_HEADER_BYTES = 4096


def encode_codes(rows: Floats, chunk_sha256: str) -> bytes:
    """The file of the codes of (n, dimension) rows, whose chunk has this hash."""
    codes = sign_codes(rows)
    arrays = [codes.norms, *codes.levels]
    body = b"".join(_padded(np.ascontiguousarray(array).tobytes()) for array in arrays)
    header = {
        **_made(rows.shape[1]),
        "rows": len(rows),
        "chunk_sha256": chunk_sha256,
        "sha256": hashlib.sha256(body).hexdigest(),
    }
    return _padded(json.dumps(header).encode(), b" ", end=b"\n") + body


def decode_codes(data: Any, *, rows: int, dimension: int, chunk_sha256: str) -> SignCodes:
    """The codes in a file's bytes, or in any buffer of them, which they go on using.

    ValueError says why they are not those of this chunk, as they are made now.
    """
    view = memoryview(data)
    line, _, _ = bytes(view[:MOST_HEADER_BYTES]).partition(b"\n")
    header = json.loads(line)  # a JSONDecodeError is a ValueError
    if not isinstance(header, dict):
        raise ValueError("no codes: the file begins otherwise")
    made = _made(dimension)
    expected = {**made, "rows": rows, "chunk_sha256": chunk_sha256}
    wrong = [name for name, value in expected.items() if header.get(name) != value]
    if wrong:
        raise ValueError(f"codes of other rows, or made otherwise: {', '.join(wrong)}")
    body = view[len(line) + 1 :]
    if hashlib.sha256(body).hexdigest() != header.get("sha256"):
        raise ValueError("the codes are not what was written: their hash differs")
    norms, at = _array(body, 0, "<f4", (rows,))
    levels = []
    for words in made["levels"]:
        level, at = _array(body, at, "<u8", (rows, words))
        levels.append(level)
    return SignCodes(tuple(levels), norms)


def _made(dimension: int) -> dict[str, Any]:
    """How codes are made: others are not compared with them."""
    return {
        "format": FORMAT,
        "dimension": dimension,
        "seed": SEED,
        "rounds": ROUNDS,
        "levels": list(level_words(rotation(dimension).padded)),
    }


def _array(
    body: memoryview, at: int, dtype: str, shape: tuple[int, ...]
) -> tuple[NDArray[Any], int]:
    """The array that begins there, and where the next one does."""
    array = np.frombuffer(body, dtype, math.prod(shape), at).reshape(shape)
    return array, at + -(-array.nbytes // ALIGNED) * ALIGNED


def _padded(data: bytes, filling: bytes = b"\0", end: bytes = b"") -> bytes:
    missing = -(len(data) + len(end)) % ALIGNED
    return data + filling * missing + end
