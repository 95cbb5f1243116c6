"""Resizing without rounding, as PyTorch's `interpolate` does it on a float tensor, in NumPy.

Each output sample is a weighted sum of input samples around its place, first along one axis and
then along the other (the weights of Keys 1981 for the cubic, a = -0.75):

    place(i)  = (i + 0.5) * size / onto - 0.5
    value(i)  = sum over j of kernel(|j - place(i)| / stretch) * sample(j)

`stretch` is 1 without antialiasing, where samples beyond the border repeat the last one; with it,
it is size / onto where that shrinks, and the weights inside the border are brought to a sum of 1.
Pillow offers neither: it rounds to whole numbers and antialiases always. Imports no torch: the
decoding children resize.

Named, versioned ways of bringing a photo to the size that a backbone sees.

The name and the version are part of the extractor spec: two ways never mix in one generation.

AnyLoc is published with more than one of them, and its figures belong to the one they were measured
with. Those scale to [0, 1], normalise by channel and then resize the normalised numbers. Here the
numbers are resized on the scale from 0 to 255, without rounding or clipping, and normalised once,
by the backbone: resizing weighs samples with weights of sum 1, so the order makes no difference.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from shared.errors import Misconfigured, Unprocessable

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


PATCH = 14  # pixels; of DINOv2
ROUND14_MAX_PIXELS = 4_194_304  # 2048 x 2048: 21,316 patches, which all attend to each other


@dataclass(frozen=True, slots=True)
class Preprocessing:
    name: str
    version: int
    upright: bool
    """Whether the photo is turned as its EXIF says. The published ways don't look at EXIF."""
    most_pixels: int
    """height x width of what comes out, at most"""
    typical_size: tuple[int, int]
    """Height and width of what comes out of most photos: those of 4 : 3 where they keep theirs."""
    resize: Callable[[Image.Image], Pixels]
    """A function of a module: it travels to the decoding children."""

    def apply(self, image: Image.Image) -> Pixels:
        """An RGB image -> (H, W, 3), 0 to 255.

        uint8; or float32 where interpolated numbers are kept as they are, which for the cubic may
        lie a little outside. Photos of different sizes may come out with different H and W.

        Unprocessable: `photo_too_small` where not one patch is left of it, `too_many_pixels` where
        it keeps its size and that is too much for a network in which every patch sees every other.
        """
        return self.resize(image)

    def as_spec(self) -> dict[str, str | int]:
        return {"name": self.name, "version": self.version}


def _squeeze(image: Image.Image, height: int, width: int) -> Pixels:
    """Aspect not kept: bilinear, antialiased when it shrinks, rounded to whole numbers."""
    return np.asarray(image.resize((width, height), Image.Resampling.BILINEAR))


def _demo1024(image: Image.Image) -> Pixels:
    """As AnyLoc's demo/anyloc_vlad_generate.py: where the longer side has more than 1024 pixels it
    becomes 1024, the other one is rounded down; then the middle, in whole patches.

    Bicubic. Not antialiased: torchvision's default for tensors until release 0.17, and AnyLoc's
    environment names 0.14.1.
    """
    width, height = image.size
    longest = max(width, height)
    if longest > 1024:
        height, width = int(height * 1024 / longest), int(width * 1024 / longest)
    _check_patches(image, height, width, "demo1024")
    return _centre_crop(resample(np.asarray(image), height, width, BICUBIC, antialias=False))


def _paper480x640(image: Image.Image) -> Pixels:
    """As AnyLoc's scripts/dino_v2_vlad.py on its data sets: 480 x 640 whatever the aspect, bilinear
    and, as above, not antialiased; of these the middle 476 x 630, which are 34 x 45 patches.
    """
    return _centre_crop(resample(np.asarray(image), 480, 640, BILINEAR, antialias=False))


def _round14(image: Image.Image) -> Pixels:
    """As AnyLoc is run by VPR-methods-evaluation: each side to the nearest multiple of 14, of two
    as near ones the even multiple; bilinear, antialiased.
    """
    height, width = (round(side / PATCH) * PATCH for side in (image.height, image.width))
    _check_patches(image, height, width, "round14")
    if height * width > ROUND14_MAX_PIXELS:
        raise Unprocessable(
            "too_many_pixels",
            f"The photo has {image.width} x {image.height} pixels, and round14 keeps its size; it "
            f"takes up to {ROUND14_MAX_PIXELS} in all. Make it smaller, or use demo1024.",
        )
    return resample(np.asarray(image), height, width, BILINEAR, antialias=True)


def _check_patches(image: Image.Image, height: int, width: int, name: str) -> None:
    if min(height, width) < PATCH:
        raise Unprocessable(
            "photo_too_small",
            f"The photo has {image.width} x {image.height} pixels, of which {name} makes {width} x "
            f"{height}: less than one patch of {PATCH} x {PATCH}. Crop it, or use square224.",
        )


def _centre_crop(pixels: Pixels) -> Pixels:
    """The middle of the pixels in whole patches; where it lies between two pixels, the even one."""
    height, width = (side // PATCH * PATCH for side in pixels.shape[:2])
    top, left = round((pixels.shape[0] - height) / 2), round((pixels.shape[1] - width) / 2)
    middle: Pixels = pixels[top : top + height, left : left + width].copy()
    return middle


PREPROCESSINGS = {
    preprocessing.name: preprocessing
    for preprocessing in (
        Preprocessing(
            "square224", 1, True, 224 * 224, (224, 224), partial(_squeeze, height=224, width=224)
        ),
        Preprocessing(
            "square32", 1, True, 32 * 32, (32, 32), partial(_squeeze, height=32, width=32)
        ),
        Preprocessing("demo1024", 1, False, 1022 * 1022, (756, 1022), _demo1024),
        Preprocessing("paper480x640", 1, False, 476 * 630, (476, 630), _paper480x640),
        Preprocessing("round14", 1, False, ROUND14_MAX_PIXELS, (770, 1022), _round14),
    )
}


def get_preprocessing(name: str) -> Preprocessing:
    """The preprocessing of that name; `resizeHEIGHTxWIDTH` is one for each size.

    Misconfigured: `unknown_preprocessing`.
    """
    if name in PREPROCESSINGS:
        return PREPROCESSINGS[name]
    size = re.fullmatch(r"resize([0-9]+)x([0-9]+)", name)
    if size is None:
        raise Misconfigured(
            "unknown_preprocessing",
            f"There is no preprocessing {name!r}. Known: {', '.join(sorted(PREPROCESSINGS))}, "
            "resizeHEIGHTxWIDTH.",
        )
    height, width = int(size[1]), int(size[2])
    return Preprocessing(
        name,
        1,
        True,
        height * width,
        (height, width),
        partial(_squeeze, height=height, width=width),
    )
