"""The fast Walsh-Hadamard transform."""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from shared.codes.compiled import ORDERED_FASTMATH, numba_jit

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
