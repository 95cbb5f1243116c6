"""The fast Walsh-Hadamard transform.

The random rotation that makes any descriptor look like noise to the codes.

Two rounds, each: random signs S, Hadamard transforms H of n equal blocks of length b, divided by
sqrt(b), and a reflection M across the blocks: of each number it takes 2/n times the sum of the n
numbers at its place in the blocks (I - 2/n J). Between the rounds runs of 16 numbers change places
at random (P):

    rotated = M H S2 P M H S1 x

Each part is orthogonal: lengths and cosines stay. (Ailon and Chazelle 2009 for the idea; rounds as
in Andoni et al. 2015, FALCONN.) One round is not enough: a row of one strong number becomes a row
of equal sizes then, which its signs alone tell apart worse than chance allows. And without P the
second round repeats the pattern of the first: rows of two to four strong numbers were misjudged by
up to 30 standard deviations from the first bits of their codes, and 7 from all; with it nothing
tried was off by more than 5. Runs of 16 are as good as single numbers there, and one cache line.

The block length b is a power of two and n is 1, 3, 5 or 7, so that little has to be padded with
zeros: 98,304 = 3 x 32,768 and 7,168 = 7 x 1,024 need none.
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

CACHE_BLOCK_FLOATS = 1024  # a stride: twice as many numbers are 8 KiB


@numba_jit(ORDERED_FASTMATH)
def _radix4(a: Float32Vector, b: Float32Vector, c: Float32Vector, d: Float32Vector) -> None:
    """Two stages at once, on four neighbouring runs of equal length."""
    for j in range(a.shape[0]):
        p, q = a[j] + c[j], b[j] + d[j]
        r, s = a[j] - c[j], b[j] - d[j]
        a[j], b[j], c[j], d[j] = p + q, p - q, r + s, r - s


def _last_strides(numbers: int) -> Any:
    @intrinsic
    def last_strides(_typing: Any, _address: types.Type) -> Any:
        """Multiply the `numbers` float32 at an address by their Hadamard matrix, in registers."""

        def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
            vector = ir.VectorType(ir.FloatType(), numbers)
            place = builder.inttoptr(arguments[0], vector.as_pointer())
            x = builder.load(place, align=4)
            stride = numbers >> 1
            while stride:
                partners = [j ^ stride for j in range(numbers)]
                lanes = ir.Constant(ir.VectorType(ir.IntType(32), numbers), partners)
                signs = ir.Constant(vector, [-1.0 if j & stride else 1.0 for j in range(numbers)])
                other = builder.shuffle_vector(x, ir.Constant(vector, ir.Undefined), lanes)
                x = builder.fadd(other, builder.fmul(x, signs))
                stride >>= 1
            builder.store(x, place, align=4)
            return _context.get_dummy_value()

        return types.void(types.intp), generate

    return last_strides


_last_16 = _last_strides(16)
_last_32 = _last_strides(32)


@numba_jit(ORDERED_FASTMATH)
def _wide_strides(x: Float32Vector, stride: int, least: int) -> int:
    """The stages of these strides, two at a time, down to `least`; the next stride."""
    while stride >= 2 * least:
        half = stride >> 1
        for begin in range(0, x.shape[0], 2 * stride):
            run = x[begin : begin + 2 * stride]
            _radix4(run[:half], run[half:stride], run[stride : stride + half], run[stride + half :])
        stride >>= 2
    return stride


@numba_jit(ORDERED_FASTMATH)
def hadamard(x: Float32Vector) -> None:
    """Multiply x, (n,) float32, by the n x n Hadamard matrix (Sylvester's, unscaled), in place.

    n is a power of two and at least 16; x is contiguous. Every loop runs over neighbours, so that
    it compiles to vector instructions, and most of them over parts that the nearest cache holds.
    """
    wide = _wide_strides(x, x.shape[0] >> 1, CACHE_BLOCK_FLOATS)
    for begin in range(0, x.shape[0], 2 * wide):
        near = x[begin : begin + 2 * wide]
        address = near.ctypes.data
        if _wide_strides(near, wide, 16) == 16:
            for at in range(0, near.shape[0], 32):
                _last_32(address + 4 * at)
        else:
            for at in range(0, near.shape[0], 16):
                _last_16(address + 4 * at)


SEED = 20_240_611
ROUNDS = 2
BLOCKS = (1, 3, 5, 7)
MIN_BLOCK = 64
SIGN_RUN = 16
COLUMNS = 1024  # that are mixed at once: of all blocks they lie in the nearest cache

Floats = NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class Rotation:
    """An orthogonal map from `dimension` numbers to `padded` numbers."""

    dimension: int
    blocks: int
    block: int
    signs: Floats
    """(ROUNDS, padded) of +1 and -1; those of the last round carry the scale of all."""
    runs: NDArray[np.uint64]
    """(padded / RUN,): the run of numbers that comes to each place between two rounds."""

    @property
    def padded(self) -> int:
        """Length of a rotated vector: a multiple of 64."""
        return self.blocks * self.block

    @property
    def error(self) -> float:
        """How far a computed rotation is from the exact one, at most, as a share of the length.

        In units of u = 2^-24, by standard rounding analysis (Higham 2002, chapters 2 and 3), for
        each round: every one of the log2(b) stages of the transform adds two numbers once, which
        errs by u of the length at most; the signs are exact, and the scale is a power of two. The
        reflection errs by 2 (n + 1) u where the sum over n blocks comes in (n - 1 additions, the
        rounded 2/n and its product) and by u where it is subtracted. Errors of one step are turned
        by the next, not stretched. A hundredth more covers the terms in u^2 and numbers so small
        that they lose bits, in rows that are not all that small.
        """
        stages = self.block.bit_length() - 1
        mixing = 2 * self.blocks + 3 if self.blocks > 1 else 0
        return 1.01 * ROUNDS * (stages + mixing) * 2.0**-24

    def rotate(self, rows: Floats) -> Floats:
        """(n, dimension) float32 -> (n, padded) float32, each row of its old length."""
        if rows.ndim != 2 or rows.shape[1] != self.dimension or rows.dtype != np.float32:
            raise ValueError(
                f"(n, {self.dimension}) float32 is rotated, not {rows.shape} {rows.dtype}"
            )
        rotated = np.empty((len(rows), self.padded), np.float32)
        _rotate(np.ascontiguousarray(rows), self.signs, self.runs, self.blocks, rotated)
        return rotated


@lru_cache(maxsize=8)
def get_rotation(dimension: int) -> Rotation:
    """The rotation of this dimension: the same one everywhere and always."""
    if dimension < 1:
        raise ValueError(f"no rotation of {dimension} dimensions")
    blocks, block = min(
        ((blocks, _block(dimension, blocks)) for blocks in BLOCKS), key=lambda size: math.prod(size)
    )
    # Philox's numbers are those of its paper (Salmon et al. 2011), and sorting is sorting: the
    # same rotation whatever NumPy's own ways of drawing become.
    draw = np.random.Philox(key=SEED)
    length = blocks * block
    bits = np.unpackbits(draw.random_raw(ROUNDS * length // 64).astype("<u8").view(np.uint8))
    signs = (2.0 * bits.reshape(ROUNDS, length) - 1.0).astype(np.float32)
    signs[-1] *= np.float32(math.sqrt(1.0 / block) ** ROUNDS)
    runs = np.argsort(draw.random_raw(length // SIGN_RUN), kind="stable").astype(np.uint64)
    return Rotation(dimension, blocks, block, signs, runs)


def _block(dimension: int, blocks: int) -> int:
    needed = max(MIN_BLOCK, -(-dimension // blocks))
    return 1 << (needed - 1).bit_length()


@numba_jit(ORDERED_FASTMATH)
def _householder(x: Floats, total: Floats) -> None:
    """(n, b): each column minus 2/n times its sum; `total` is room for the sums of some."""
    blocks, block = x.shape
    share = np.float32(2.0 / blocks)
    for begin in range(0, block, total.shape[0]):
        end = min(block, begin + total.shape[0])
        some = total[: end - begin]
        some[:] = x[0, begin:end]
        for i in range(1, blocks):
            part = x[i, begin:end]
            for j in range(part.shape[0]):
                some[j] += part[j]
        for i in range(blocks):
            part = x[i, begin:end]
            for j in range(part.shape[0]):
                part[j] -= share * some[j]


@numba_jit(ORDERED_FASTMATH)
def _rotate(
    rows: Floats, signs: Floats, runs: NDArray[np.uint64], blocks: int, out: Floats
) -> None:
    dimension = rows.shape[1]
    before = np.empty(out.shape[1], np.float32)
    total = np.empty(COLUMNS, np.float32)
    for number in range(rows.shape[0]):
        row, rotated = rows[number], out[number]
        for j in range(dimension):
            rotated[j] = row[j] * signs[0, j]
        rotated[dimension:] = 0.0
        for turn in range(signs.shape[0]):
            if turn > 0:
                before[:] = rotated
                come, there = before.reshape(-1, SIGN_RUN), rotated.reshape(-1, SIGN_RUN)
                flips = signs[turn].reshape(-1, SIGN_RUN)
                for place in range(runs.shape[0]):
                    run = runs[place]
                    for j in range(SIGN_RUN):
                        there[place, j] = come[run, j] * flips[place, j]
            parts = rotated.reshape(blocks, -1)
            for part in range(blocks):
                hadamard(parts[part])
            if blocks > 1:
                _householder(parts, total)
