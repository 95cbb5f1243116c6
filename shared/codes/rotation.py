"""Random rotation of descriptors before coding, by fast Walsh-Hadamard transforms.

After the rotation, the numbers of any descriptor look like random noise to the codes. It has two
rounds, each with: random signs S; Hadamard transforms H of n equal blocks of length b, divided by
sqrt(b); and a reflection M across the blocks (Householder, I - 2/n J), which subtracts from each
number 2/n times the sum of the n numbers at its position in the blocks. Between the rounds, runs of
16 numbers are permuted at random (P):

    rotated = M H S2 P M H S1 x

Each part is orthogonal, so lengths and cosines are preserved. (Ailon and Chazelle 2009 for the
idea; rounds as in Andoni et al. 2015, FALCONN.)

One round is not enough: a row with one dominant number becomes a row of equal magnitudes, which its
signs alone distinguish worse than chance would allow. Without P, the second round repeats the
pattern of the first: rows with two to four dominant numbers were misestimated by up to 30 standard
deviations from the first bits of their codes, and by 7 from all bits; with P, no row that was tried
was off by more than 5. Permuting runs of 16 is as good as permuting single numbers, and a run is
one cache line.

The block length b is a power of two and n is 1, 3, 5 or 7, so that little zero padding is needed:
98,304 = 3 x 32,768 and 7,168 = 7 x 1,024 need none.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from shared.codes.jit import ORDERED_FASTMATH, numba_jit

Float32Vector = NDArray[np.float32]

CACHE_BLOCK_FLOATS = 1024  # stride up to which blocks, 8 KiB of twice as many floats, fit in L1


@numba_jit(ORDERED_FASTMATH)
def _radix4(a: Float32Vector, b: Float32Vector, c: Float32Vector, d: Float32Vector) -> None:
    """Two butterfly stages at once, on four adjacent runs of equal length."""
    for j in range(a.shape[0]):
        p, q = a[j] + c[j], b[j] + d[j]
        r, s = a[j] - c[j], b[j] - d[j]
        a[j], b[j], c[j], d[j] = p + q, p - q, r + s, r - s


def _last_strides(numbers: int) -> Any:
    @intrinsic
    def last_strides(_typing: Any, _address: types.Type) -> Any:
        """Multiply `numbers` float32 at an address by their Hadamard matrix, in registers."""

        def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
            vector = ir.VectorType(ir.FloatType(), numbers)
            pointer = builder.inttoptr(arguments[0], vector.as_pointer())
            x = builder.load(pointer, align=4)
            stride = numbers >> 1
            while stride:
                partners = [j ^ stride for j in range(numbers)]
                lanes = ir.Constant(ir.VectorType(ir.IntType(32), numbers), partners)
                signs = ir.Constant(vector, [-1.0 if j & stride else 1.0 for j in range(numbers)])
                other = builder.shuffle_vector(x, ir.Constant(vector, ir.Undefined), lanes)
                x = builder.fadd(other, builder.fmul(x, signs))
                stride >>= 1
            builder.store(x, pointer, align=4)
            return _context.get_dummy_value()

        return types.void(types.intp), generate

    return last_strides


_last_16 = _last_strides(16)
_last_32 = _last_strides(32)


@numba_jit(ORDERED_FASTMATH)
def _wide_strides(x: Float32Vector, stride: int, min_stride: int) -> int:
    """Run the stages from `stride` down to `min_stride`, two at a time; return the next stride."""
    while stride >= 2 * min_stride:
        half = stride >> 1
        for begin in range(0, x.shape[0], 2 * stride):
            run = x[begin : begin + 2 * stride]
            _radix4(run[:half], run[half:stride], run[stride : stride + half], run[stride + half :])
        stride >>= 2
    return stride


@numba_jit(ORDERED_FASTMATH)
def _hadamard(x: Float32Vector) -> None:
    """Multiply x, (n,) float32, by the n x n Hadamard matrix (Sylvester's, unscaled), in place.

    n is a power of two and at least 16; x is contiguous. Every loop runs over adjacent numbers, so
    that it is vectorized, and most of them over blocks that fit into the L1 cache.
    """
    block_stride = _wide_strides(x, x.shape[0] >> 1, CACHE_BLOCK_FLOATS)
    for begin in range(0, x.shape[0], 2 * block_stride):
        block = x[begin : begin + 2 * block_stride]
        address = block.ctypes.data
        if _wide_strides(block, block_stride, 16) == 16:
            for offset in range(0, block.shape[0], 32):
                _last_32(address + 4 * offset)
        else:
            for offset in range(0, block.shape[0], 16):
                _last_16(address + 4 * offset)


SEED = 20_240_611
ROUNDS = 2
BLOCKS = (1, 3, 5, 7)
MIN_BLOCK = 64
SIGN_RUN = 16
COLUMNS = 1024  # columns reflected at once: those of all blocks fit into the L1 cache

Floats = NDArray[np.float32]
StoredFloats = NDArray[np.float32] | NDArray[np.float16]


@dataclass(frozen=True, slots=True, eq=False)
class Rotation:
    """Orthogonal map from `dimension` numbers to `padded` numbers."""

    dimension: int
    blocks: int
    block: int
    signs: Floats
    """(ROUNDS, padded) of +1 and -1; the last round's include the scale of all rounds."""
    runs: NDArray[np.uint64]
    """(padded / SIGN_RUN,): for each position, the run moved there between two rounds."""

    @property
    def padded(self) -> int:
        """Length of a rotated vector, a multiple of 64."""
        return self.blocks * self.block

    def rotate(self, rows: Floats) -> Floats:
        """Rotate (n, dimension) float32 rows to (n, padded) float32; lengths are preserved.

        Raises:
            ValueError: The shape or dtype is wrong.
        """
        if rows.ndim != 2 or rows.shape[1] != self.dimension or rows.dtype != np.float32:
            raise ValueError(
                f"expected rows of shape (n, {self.dimension}) float32, got {rows.shape} "
                f"{rows.dtype}"
            )
        rotated = np.empty((len(rows), self.padded), np.float32)
        _rotate(np.ascontiguousarray(rows), self.signs, self.runs, self.blocks, rotated)
        return rotated


@lru_cache(maxsize=8)
def get_rotation(dimension: int) -> Rotation:
    """Return the rotation of this dimension, which is the same on every machine and release."""
    if dimension < 1:
        raise ValueError(f"the dimension must be at least 1, not {dimension}")
    blocks, block = min(
        ((blocks, _block(dimension, blocks)) for blocks in BLOCKS), key=lambda size: math.prod(size)
    )
    # Raw numbers of Philox are defined by its paper (Salmon et al. 2011), and a stable sort is
    # deterministic: the rotation does not depend on NumPy's sampling methods, which may change.
    rng = np.random.Philox(key=SEED)
    length = blocks * block
    bits = np.unpackbits(rng.random_raw(ROUNDS * length // 64).astype("<u8").view(np.uint8))
    signs = (2.0 * bits.reshape(ROUNDS, length) - 1.0).astype(np.float32)
    signs[-1] *= np.float32(math.sqrt(1.0 / block) ** ROUNDS)
    runs = np.argsort(rng.random_raw(length // SIGN_RUN), kind="stable").astype(np.uint64)
    return Rotation(dimension, blocks, block, signs, runs)


def _block(dimension: int, blocks: int) -> int:
    needed = max(MIN_BLOCK, -(-dimension // blocks))
    return 1 << (needed - 1).bit_length()


@numba_jit(ORDERED_FASTMATH)
def _householder(x: Floats, buffer: Floats) -> None:
    """Reflect (n, b) in place: subtract from each column 2/n times its sum.

    `buffer` holds the sums of some columns at a time.
    """
    blocks, block = x.shape
    factor = np.float32(2.0 / blocks)
    for begin in range(0, block, buffer.shape[0]):
        end = min(block, begin + buffer.shape[0])
        sums = buffer[: end - begin]
        sums[:] = x[0, begin:end]
        for i in range(1, blocks):
            block_part = x[i, begin:end]
            for j in range(block_part.shape[0]):
                sums[j] += block_part[j]
        for i in range(blocks):
            block_part = x[i, begin:end]
            for j in range(block_part.shape[0]):
                block_part[j] -= factor * sums[j]


@numba_jit(ORDERED_FASTMATH)
def _rotate(
    rows: Floats, signs: Floats, runs: NDArray[np.uint64], blocks: int, out: Floats
) -> None:
    dimension = rows.shape[1]
    previous = np.empty(out.shape[1], np.float32)
    buffer = np.empty(COLUMNS, np.float32)
    for index in range(rows.shape[0]):
        row, rotated = rows[index], out[index]
        for j in range(dimension):
            rotated[j] = row[j] * signs[0, j]
        rotated[dimension:] = 0.0
        for round_index in range(signs.shape[0]):
            if round_index > 0:
                previous[:] = rotated
                source, destination = previous.reshape(-1, SIGN_RUN), rotated.reshape(-1, SIGN_RUN)
                round_signs = signs[round_index].reshape(-1, SIGN_RUN)
                for position in range(runs.shape[0]):
                    run = runs[position]
                    for j in range(SIGN_RUN):
                        destination[position, j] = source[run, j] * round_signs[position, j]
            parts = rotated.reshape(blocks, -1)
            for block_index in range(blocks):
                _hadamard(parts[block_index])
            if blocks > 1:
                _householder(parts, buffer)
