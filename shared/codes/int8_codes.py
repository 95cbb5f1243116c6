"""Int8 codes: one byte for each number of the rotated row, and how far off they are at most.

Of a row x the code keeps whole numbers w, -127 to 127, and a scale s: its rotation Rx is about
s w. A query of length 1, u, becomes whole numbers of 15 bits, W, and a scale t. Rotations keep
products, so for the exact rotation R

    <u, x> - st <w, W> = <Ru - tW, sw> + <Ru, Rx - sw>

and by Cauchy and Schwarz, whatever the rows hold,

    |<u, x> - st <w, W>| <= |Ru - tW| |sw| + |Rx - sw|.

These are upper bounds, not estimates. What they count:

* `errors`, |Rx - sw|: the length of what rounding to w left over, measured against the computed
  rotation, and `Rotation.error` of the row's length, by which that may be off;
* the same of the query, `Int8Query.error`, and the rounding of u to float32, 2^-24;
* `lengths`, |sw|.

Sums of squares are float64 sums of m terms, whose error is less than m 2^-53 of them: 2 10^-11 at
131,072 numbers. Each bound is made larger by SAFETY, fifty times that, and rounded up to float32.
<w, W> is computed in whole numbers, without any error.

At 98,304 numbers, `errors` is about 0.0103 and the query adds 0.0001: a query in 8 bits would
double the sum, and one in 16 costs no more to multiply by.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shared.codes.jit import REORDERED_FASTMATH, numba_jit
from shared.codes.rotation import Floats, get_rotation
from shared.codes.sign_codes import ROWS_PER_BLOCK

INT8_MAX = 127
QUERY_MAX = 127 * 128 + 63  # so that both of its parts are bytes: 128 high + low
ROUNDING_MARGIN = 1e-9
MIN_SCALE = 1e-30  # rows with nothing larger are kept as zeros: their scale would be no number

Bytes = NDArray[np.int8]
Shorts = NDArray[np.int16]


@dataclass(frozen=True, slots=True, eq=False)
class Int8Codes:
    """The codes of n rows of one dimension."""

    numbers: Bytes
    """(n, padded): w."""
    scales: Floats
    """(n,): s."""
    errors: Floats
    """(n,): |Rx - sw| at most."""
    lengths: Floats
    """(n,): |sw| at most."""

    def __len__(self) -> int:
        return len(self.scales)

    @property
    def nbytes(self) -> int:
        return self.numbers.nbytes + self.scales.nbytes + self.errors.nbytes + self.lengths.nbytes


@dataclass(frozen=True, slots=True, eq=False)
class Int8Query:
    """A query of length 1, as int8 codes need it."""

    numbers: Shorts
    """(padded,): W."""
    scale: float
    """t"""
    error: float
    """|Ru - tW| at most."""

    @classmethod
    def from_row(cls, row: Floats) -> Int8Query:
        """Of a (dimension,) float32 row of any length but 0."""
        exact = row.astype(np.float64)
        unit: Floats = (exact / np.linalg.norm(exact)).astype(np.float32)
        turn = get_rotation(len(row))
        numbers = np.empty((1, turn.padded), np.int16)
        figures = np.empty((1, 4))
        _quantize(turn.rotate(unit[np.newaxis]), QUERY_MAX, numbers, figures)
        scale, left, _, _ = figures[0].tolist()
        error = (left + 1.01 * (turn.error + 2.0**-24)) * (1 + ROUNDING_MARGIN)
        return cls(numbers[0], scale, error)

    @property
    def parts(self) -> Bytes:
        """(2, padded): bytes of which 128 times the first plus the second are the numbers."""
        high = (self.numbers + 64) >> 7
        return np.stack([high, self.numbers - 128 * high]).astype(np.int8)


def int8_codes(rows: Floats) -> Int8Codes:
    """The codes of (n, dimension) float32 rows; of rows of zeros: zeros."""
    turn = get_rotation(rows.shape[1])
    numbers = np.empty((len(rows), turn.padded), np.int8)
    figures = np.empty((len(rows), 4))
    at_once = max(ROWS_PER_BLOCK, (1 << 22) // turn.padded)
    for begin in range(0, len(rows), at_once):
        part = slice(begin, begin + at_once)
        _quantize(turn.rotate(rows[part]), INT8_MAX, numbers[part], figures[part])
    scales, left, rounded, whole = figures.T
    errors = left + turn.error * whole / (1 - turn.error)
    return Int8Codes(numbers, scales.astype(np.float32), _round_up(errors), _round_up(rounded))


def _round_up(bounds: NDArray[np.float64]) -> Floats:
    """Rounded up; 0 stays 0."""
    single = (bounds * (1 + ROUNDING_MARGIN)).astype(np.float32)
    found: Floats = np.where(bounds > 0, np.nextafter(single, np.float32(math.inf)), single)
    return found


@numba_jit(REORDERED_FASTMATH)
def _quantize(
    rotated: Floats, most: int, numbers: Bytes | Shorts, figures: NDArray[np.float64]
) -> None:
    """Round each of (n, m) float32 rows to whole numbers of -most to most, and measure the result.

    figures (n, 4): the scale (a float32), the length of what was left over, that of the rounded
    row, and that of the row itself.
    """
    for number in range(rotated.shape[0]):
        row, out = rotated[number], numbers[number]
        largest = np.float32(0.0)
        for j in range(row.shape[0]):
            largest = max(largest, abs(row[j]))
        scale = inverse = np.float32(0.0)
        if largest > np.float32(MIN_SCALE):
            scale = largest / np.float32(most)
            inverse = np.float32(most) / largest
        left = rounded = whole = 0.0
        for j in range(row.shape[0]):
            nearest = np.rint(row[j] * inverse)
            out[j] = np.int16(nearest)
            stands_for = np.float64(scale) * np.float64(nearest)
            apart = np.float64(row[j]) - stands_for
            left += apart * apart
            rounded += stands_for * stands_for
            whole += np.float64(row[j]) * np.float64(row[j])
        figures[number, 0] = scale
        figures[number, 1] = math.sqrt(left)
        figures[number, 2] = math.sqrt(rounded)
        figures[number, 3] = math.sqrt(whole)
