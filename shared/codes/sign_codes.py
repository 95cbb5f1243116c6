"""Sign codes: one bit for each number of the rotated row, with known estimation errors.

The code of a rotated row x, (m,), holds its signs. For a unit row and a unit query q with cosine c,
and random rotations, c is estimated

* from the signs of both, of which h of m differ: cos(pi h / m) (Charikar 2002; Goemans and
  Williamson 1995), with a standard deviation of at most (pi / 2) / sqrt(m) of the angle, and so of
  c;
* from the signs of the row and the query q: <q, sign(x)> / |x|_1 (RaBitQ, Gao and Long 2024),
  unbiased, with a standard deviation of at most sqrt((1 / f^2 - 1) / (m - 1)), where f = |x|_1 /
  sqrt(m) of the row: 0.798 for noise, 1 for a row of equal magnitudes.

Both errors are those of the rotation, not of the data: they hold for any rows.

A code is stored in levels: the first bits of all rows are contiguous, so that a scan of the first
level reads little memory. Bit j of word i is the sign of number 64 i + j, 1 for a number that is
not negative.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared.codes.rotation import Floats, StoredFloats, get_rotation

WORD_BITS = 64
FIRST_LEVEL_BITS = 4096
SECOND_LEVEL_BITS = 16_384

Words = NDArray[np.uint64]

ROWS_PER_BLOCK = 64  # rows rotated at once: 25 MB at 98,304 dimensions


@dataclass(frozen=True, slots=True, eq=False)
class SignCodes:
    """Sign codes of n rows of one dimension."""

    levels: tuple[Words, ...]
    """(n, words) each: the levels' bits, concatenated, are the whole code."""
    norms: Floats
    """(n,): |x|_1 of the rotated unit row; 0 for a row of zeros, whose bits are meaningless."""

    def __len__(self) -> int:
        return len(self.norms)


def level_words(padded: int) -> tuple[int, ...]:
    """Number of 64-bit words of each level of a code of `padded` bits."""
    return tuple(np.diff(level_ends(padded), prepend=0).tolist())


@lru_cache(maxsize=8)
def level_ends(padded: int) -> NDArray[np.int64]:
    """(levels,): the word at which each level of a code of `padded` bits ends."""
    first_ends = [
        end // WORD_BITS for end in (FIRST_LEVEL_BITS, SECOND_LEVEL_BITS) if 2 * end <= padded
    ]
    ends = np.array([*first_ends, padded // WORD_BITS], np.int64)
    ends.flags.writeable = False
    return ends


def encode_signs(rows: StoredFloats) -> SignCodes:
    """Compute the codes of (n, dimension) float32 or float16 rows of length 1 or 0."""
    rotation = get_rotation(rows.shape[1])
    words = np.empty((len(rows), rotation.padded // WORD_BITS), np.uint64)
    norms = np.empty(len(rows), np.float32)
    for begin in range(0, len(rows), ROWS_PER_BLOCK):
        block = slice(begin, begin + ROWS_PER_BLOCK)
        rotated = rotation.rotate(rows[block].astype(np.float32, copy=False))
        words[block] = pack_signs(rotated)
        norms[block] = np.abs(rotated).sum(axis=1, dtype=np.float64)
    level_parts = np.split(words, level_ends(rotation.padded)[:-1], axis=1)
    levels = tuple(np.ascontiguousarray(level) for level in level_parts)
    return SignCodes(levels, norms)


def pack_signs(rotated: Floats) -> Words:
    """Pack the signs of (n, m) float32 numbers, m a multiple of 64, into (n, m / 64) uint64."""
    return pack_bits(rotated >= 0)


def pack_bits(bits: NDArray[Any]) -> Words:
    """Pack (n, m) bits, numbers that are 0 or not, m a multiple of 64, into (n, m / 64) uint64."""
    packed = np.packbits(bits, axis=-1, bitorder="little")
    return packed.view("<u8").astype(np.uint64, copy=False)
