"""Int8 codes: one byte for each number of the rotated row, with a proven error bound.

The code of a row x holds integers w, -127 to 127, and a scale s, so that the rotated row Rx is
about s w. A query u of length 1 is quantized to 15-bit integers W with a scale t. Rotations
preserve dot products, so for the exact rotation R

    <u, x> - st <w, W> = <Ru - tW, sw> + <Ru, Rx - sw>

and by the Cauchy-Schwarz inequality, for any rows,

    |<u, x> - st <w, W>| <= |Ru - tW| |sw| + |Rx - sw|.

These are upper bounds, not estimates. They include:

* `errors`, |Rx - sw|: the length of the rounding residual, measured against the computed rotation,
  plus `Rotation.error` times the row's length, by which the computed rotation may be off;
* the same of the query, `Int8Query.error`, with the rounding of u to float32, 2^-24;
* `lengths`, |sw|.

Sums of squares are float64 sums of m terms, whose error is less than m 2^-53 of them: 2 10^-11 at
131,072 numbers. Each bound is increased by ROUNDING_MARGIN, fifty times that, and rounded up to
float32. <w, W> is computed in integers, without any error.

At 98,304 numbers, `errors` is about 0.0103 and the query adds 0.0001: an 8-bit query would double
the sum, and a 16-bit one costs no more to multiply by.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shared.codes.jit import REORDERED_FASTMATH, numba_jit
from shared.codes.rotation import Floats, StoredFloats, get_rotation
from shared.codes.sign_codes import ROWS_PER_BLOCK

INT8_MAX = 127
QUERY_MAX = 127 * 128 + 63
ROUNDING_MARGIN = 1e-9
MIN_SCALE = 1e-30  # rows without a larger number become zeros: their scale would leave float32

Bytes = NDArray[np.int8]
Shorts = NDArray[np.int16]


@dataclass(frozen=True, slots=True, eq=False)
class Int8Codes:
    """Int8 codes of n rows of one dimension."""

    numbers: Bytes
    """(n, padded): w."""
    scales: Floats
    """(n,): s."""
    errors: Floats
    """(n,): upper bound of |Rx - sw|."""
    lengths: Floats
    """(n,): upper bound of |sw|."""

    def __len__(self) -> int:
        return len(self.scales)

    @property
    def nbytes(self) -> int:
        return self.numbers.nbytes + self.scales.nbytes + self.errors.nbytes + self.lengths.nbytes


@dataclass(frozen=True, slots=True, eq=False)
class Int8Query:
    """A quantized query of length 1."""

    numbers: Shorts
    """(padded,): W."""
    scale: float
    """t."""
    error: float
    """Upper bound of |Ru - tW|."""

    @classmethod
    def from_row(cls, row: Floats) -> Int8Query:
        """Quantize a (dimension,) float32 row of any length but 0."""
        exact = row.astype(np.float64)
        unit: Floats = (exact / np.linalg.norm(exact)).astype(np.float32)
        rotation = get_rotation(len(row))
        numbers = np.empty((1, rotation.padded), np.int16)
        measures = np.empty((1, 4))
        _quantize(rotation.rotate(unit[np.newaxis]), QUERY_MAX, numbers, measures)
        scale, residual, _, _ = measures[0].tolist()
        error = (residual + 1.01 * (rotation.error + 2.0**-24)) * (1 + ROUNDING_MARGIN)
        return cls(numbers[0], scale, error)


def int8_codes(rows: StoredFloats) -> Int8Codes:
    """Compute the codes of (n, dimension) float32 or float16 rows; zeros have codes of zeros."""
    rotation = get_rotation(rows.shape[1])
    numbers = np.empty((len(rows), rotation.padded), np.int8)
    measures = np.empty((len(rows), 4))
    batch_rows = max(ROWS_PER_BLOCK, (1 << 22) // rotation.padded)
    for begin in range(0, len(rows), batch_rows):
        batch = slice(begin, begin + batch_rows)
        rotated = rotation.rotate(rows[batch].astype(np.float32, copy=False))
        _quantize(rotated, INT8_MAX, numbers[batch], measures[batch])
    scales, residuals, lengths, norms = measures.T
    errors = residuals + rotation.error * norms / (1 - rotation.error)
    return Int8Codes(numbers, scales.astype(np.float32), _round_up(errors), _round_up(lengths))


def _round_up(bounds: NDArray[np.float64]) -> Floats:
    """Add ROUNDING_MARGIN and round up to float32; 0 stays 0."""
    single = (bounds * (1 + ROUNDING_MARGIN)).astype(np.float32)
    rounded: Floats = np.where(bounds > 0, np.nextafter(single, np.float32(math.inf)), single)
    return rounded


@numba_jit(REORDERED_FASTMATH)
def _quantize(
    rotated: Floats, max_value: int, numbers: Bytes | Shorts, measures: NDArray[np.float64]
) -> None:
    """Round (n, m) float32 rows to integers of at most `max_value`, and measure the result.

    `measures` (n, 4) float64: the scale (a float32 value), the lengths of the residual and of the
    rounded row, and the length of the row.
    """
    for index in range(rotated.shape[0]):
        row, out = rotated[index], numbers[index]
        largest = np.float32(0.0)
        for j in range(row.shape[0]):
            largest = max(largest, abs(row[j]))
        scale = inverse = np.float32(0.0)
        if largest > np.float32(MIN_SCALE):
            scale = largest / np.float32(max_value)
            inverse = np.float32(max_value) / largest
        residual = length = norm = 0.0
        for j in range(row.shape[0]):
            quantized = np.rint(row[j] * inverse)
            out[j] = np.int16(quantized)
            restored = np.float64(scale) * np.float64(quantized)
            difference = np.float64(row[j]) - restored
            residual += difference * difference
            length += restored * restored
            norm += np.float64(row[j]) * np.float64(row[j])
        measures[index, 0] = scale
        measures[index, 1] = math.sqrt(residual)
        measures[index, 2] = math.sqrt(length)
        measures[index, 3] = math.sqrt(norm)
