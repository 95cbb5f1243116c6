"""Resizing without rounding, as PyTorch's `interpolate` does it on a float tensor, in NumPy.

Each output sample is a weighted sum of input samples around its place, first along one axis and
then along the other (the weights of Keys 1981 for the cubic, a = -0.75):

    place(i)  = (i + 0.5) * size / onto - 0.5
    value(i)  = sum over j of kernel(|j - place(i)| / stretch) * sample(j)

`stretch` is 1 without antialiasing, where samples beyond the border repeat the last one; with it,
it is size / onto where that shrinks, and the weights inside the border are brought to a sum of 1.
Pillow offers neither: it rounds to whole numbers and antialiases always. Imports no torch: the
decoding children resize.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[np.uint8 | np.float32]
Weights = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Kernel:
    weigh: Callable[[NDArray[np.float64]], NDArray[np.float64]]
    """Weights by the distance, in samples, which is not negative."""
    radius: int
    """The distance from which on the weight is 0."""


def _triangle(distance: NDArray[np.float64]) -> NDArray[np.float64]:
    weights: NDArray[np.float64] = np.maximum(1.0 - distance, 0.0)
    return weights


def _cubic(distance: NDArray[np.float64]) -> NDArray[np.float64]:
    a, x = -0.75, distance
    near = ((a + 2) * x - (a + 3)) * x * x + 1
    far = ((a * x - 5 * a) * x + 8 * a) * x - 4 * a
    weights: NDArray[np.float64] = np.where(x <= 1, near, np.where(x < 2, far, 0.0))
    return weights


BILINEAR = Kernel(_triangle, radius=1)
BICUBIC = Kernel(_cubic, radius=2)


def resample(pixels: Pixels, height: int, width: int, kernel: Kernel, *, antialias: bool) -> Pixels:
    """(H, W, C) -> (height, width, C) float32, on the same scale and not clipped to it.

    What has the size already comes back as it is.
    """
    had_height, had_width = pixels.shape[:2]
    # The axis first that leaves less to do, and less to hold.
    sizes = {0: height, 1: width}
    order = (0, 1) if height * had_width <= had_height * width else (1, 0)
    for axis in order:
        if pixels.shape[axis] != sizes[axis]:
            pixels = _resample_axis(pixels, axis, sizes[axis], kernel, antialias)
    return pixels


def _resample_axis(
    pixels: Pixels, axis: int, onto: int, kernel: Kernel, antialias: bool
) -> NDArray[np.float32]:
    taken, weights = _axis_weights(pixels.shape[axis], onto, kernel, antialias)
    shape = [1] * pixels.ndim
    shape[axis] = onto
    total = np.zeros((*pixels.shape[:axis], onto, *pixels.shape[axis + 1 :]), np.float32)
    for tap in range(taken.shape[1]):
        total += weights[:, tap].reshape(shape) * pixels.take(taken[:, tap], axis=axis)
    return total


def _axis_weights(
    size: int, onto: int, kernel: Kernel, antialias: bool
) -> tuple[NDArray[np.intp], Weights]:
    """(onto, taps) indices of the samples that each output sample is made of, and their weights."""
    # In float32, as PyTorch: at a thousand pixels its places are off by up to 1e-4.
    scale = np.float32(size) / np.float32(onto)
    stretch = max(scale, np.float32(1)) if antialias else np.float32(1)
    places = (np.arange(onto, dtype=np.float32) + np.float32(0.5)) * scale - np.float32(0.5)
    first = np.floor(places - kernel.radius * stretch).astype(np.intp) + 1
    taps = first[:, np.newaxis] + np.arange(int(np.ceil(2 * kernel.radius * stretch)))
    weights = kernel.weigh(np.abs(taps - places[:, np.newaxis]) / stretch)
    if antialias:
        weights = np.where((taps < 0) | (taps >= size), 0.0, weights)
        weights /= weights.sum(axis=1, keepdims=True)
    return taps.clip(0, size - 1), weights.astype(np.float32)
