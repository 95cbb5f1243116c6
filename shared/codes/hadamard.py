"""The fast Walsh-Hadamard transform."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from shared.codes.compiled import IN_ORDER, compiled

Floats = NDArray[np.float32]

NEAR = 1024  # a stride: twice as many numbers are 8 KiB


@compiled(IN_ORDER)
def _radix4(a: Floats, b: Floats, c: Floats, d: Floats) -> None:
    """Two stages at once, on four neighbouring runs of equal length."""
    for j in range(a.shape[0]):
        p, q = a[j] + c[j], b[j] + d[j]
        r, s = a[j] - c[j], b[j] - d[j]
        a[j], b[j], c[j], d[j] = p + q, p - q, r + s, r - s


@compiled(IN_ORDER)
def _radix2(a: Floats, b: Floats) -> None:
    for j in range(a.shape[0]):
        a[j], b[j] = a[j] + b[j], a[j] - b[j]


@compiled(IN_ORDER)
def _strides_4_and_8(x: Floats) -> None:
    groups = x.reshape(-1, 16)
    for j in range(groups.shape[0]):
        for i in range(4):
            a, b, c, d = groups[j, i], groups[j, i + 4], groups[j, i + 8], groups[j, i + 12]
            p, q, r, s = a + c, b + d, a - c, b - d
            groups[j, i], groups[j, i + 4] = p + q, p - q
            groups[j, i + 8], groups[j, i + 12] = r + s, r - s


@compiled(IN_ORDER)
def _strides_1_and_2(x: Floats) -> None:
    groups = x.reshape(-1, 4)
    for j in range(groups.shape[0]):
        a, b, c, d = groups[j, 0], groups[j, 1], groups[j, 2], groups[j, 3]
        p, q, r, s = a + c, b + d, a - c, b - d
        groups[j, 0], groups[j, 1] = p + q, p - q
        groups[j, 2], groups[j, 3] = r + s, r - s


@compiled(IN_ORDER)
def _wide_strides(x: Floats, stride: int, least: int) -> int:
    """The stages of these strides, two at a time, down to `least`; the next stride."""
    while stride >= 2 * least:
        half = stride >> 1
        for begin in range(0, x.shape[0], 2 * stride):
            run = x[begin : begin + 2 * stride]
            _radix4(run[:half], run[half:stride], run[stride : stride + half], run[stride + half :])
        stride >>= 2
    return stride


@compiled(IN_ORDER)
def hadamard(x: Floats) -> None:
    """Multiply x, (n,) float32, by the n x n Hadamard matrix (Sylvester's, unscaled), in place.

    n is a power of two and at least 16. Every loop runs over neighbours, so that it compiles to
    vector instructions, and most of them over parts that the nearest cache holds.
    """
    wide = _wide_strides(x, x.shape[0] >> 1, NEAR)
    for begin in range(0, x.shape[0], 2 * wide):
        near = x[begin : begin + 2 * wide]
        stride = _wide_strides(near, wide, 16)
        if stride == 16:
            for at in range(0, near.shape[0], 32):
                _radix2(near[at : at + 16], near[at + 16 : at + 32])
        _strides_4_and_8(near)
        _strides_1_and_2(near)
