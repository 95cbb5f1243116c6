"""Sign codes: one bit for each number of the rotated row, and how far they can be trusted.

Of a rotated row x, (m,), the code keeps the signs. For a unit row and a unit query q with the
cosine c, whose rotations are random:

* from the signs of both, h of m differ:       cos(pi h / m)       (Charikar 2002; Goemans and
  Williamson 1995), standard deviation at most (pi / 2) / sqrt(m) of the angle, and so of c;
* from the signs of the row and the query q:   <q, sign(x)> / |x|_1       (RaBitQ, Gao and Long
  2024), unbiased, standard deviation at most sqrt((1 / f^2 - 1) / (m - 1)) with the row's own
  f = |x|_1 / sqrt(m): 0.798 for noise, 1 for a row of equal sizes.

Both errors are those of the rotation, not of the data: they hold for any rows.

A code is kept in levels: the first bits of all rows lie together, so that most rows cost a glance.
Bits of one word: bit j of word i is the sign of number 64 i + j, 1 for what is not negative.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from shared.codes.rotation import Floats, get_rotation

WORD_BITS = 64
FIRST_LEVEL_BITS = 4096
SECOND_LEVEL_BITS = 16_384

Words = NDArray[np.uint64]

ROWS_PER_BLOCK = 64  # that are rotated together: 25 MB at 98,304 dimensions


@dataclass(frozen=True, slots=True, eq=False)
class SignCodes:
    """The codes of n rows of one dimension."""

    levels: tuple[Words, ...]
    """(n, words) each: the bits of all levels, one after the other, are the whole code."""
    norms: Floats
    """(n,): |x|_1 of the unit row's rotation; 0 for a row of zeros, whose bits mean nothing."""

    def __len__(self) -> int:
        return len(self.norms)


def level_words(padded: int) -> tuple[int, ...]:
    """The 64-bit words of each level of a code of `padded` bits; their sum is the whole code."""
    return tuple(np.diff(level_ends(padded), prepend=0).tolist())


@lru_cache(maxsize=8)
def level_ends(padded: int) -> NDArray[np.int64]:
    """(levels,): up to which word each level of a code of `padded` bits goes."""
    firsts = [
        end // WORD_BITS for end in (FIRST_LEVEL_BITS, SECOND_LEVEL_BITS) if 2 * end <= padded
    ]
    ends = np.array([*firsts, padded // WORD_BITS], np.int64)
    ends.flags.writeable = False
    return ends


def encode_signs(rows: Floats) -> SignCodes:
    """The codes of (n, dimension) float32 rows of length 1 or 0."""
    turn = get_rotation(rows.shape[1])
    words = np.empty((len(rows), turn.padded // WORD_BITS), np.uint64)
    norms = np.empty(len(rows), np.float32)
    for begin in range(0, len(rows), ROWS_PER_BLOCK):
        part = slice(begin, begin + ROWS_PER_BLOCK)
        rotated = turn.rotate(rows[part])
        words[part] = pack_signs(rotated)
        norms[part] = np.abs(rotated).sum(axis=1, dtype=np.float64)
    parts = np.split(words, level_ends(turn.padded)[:-1], axis=1)
    levels = tuple(np.ascontiguousarray(level) for level in parts)
    return SignCodes(levels, norms)


def pack_signs(rotated: Floats) -> Words:
    """(n, m) float32, m a multiple of 64 -> (n, m / 64)."""
    bits = np.packbits(rotated >= 0, axis=-1, bitorder="little")
    return bits.view("<u8").astype(np.uint64, copy=False)
