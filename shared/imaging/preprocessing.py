"""Preprocessings: named, versioned ways to resize a photo for a backbone, and the NumPy resampler.

Name and version are part of the extractor spec, so that one generation never mixes two of them.

AnyLoc is published with several preprocessings, and each published result belongs to one of them.
AnyLoc scales to [0, 1], normalises by channel and then resizes. Here pixels are resized on the
scale from 0 to 255, without rounding or clipping, and normalised once, by the backbone: the
weights of a resize have sum 1, so the order makes no difference.

`resample` resizes without rounding, as PyTorch's `interpolate` does on a float tensor. Pillow can't
do this: it rounds to integers and always antialiases. torch is not imported, because the decoding
child processes resize. Each output sample is a weighted sum of input samples around its position,
first along one axis and then along the other (the weights of Keys 1981 for the cubic, a = -0.75):

    position(i)  = (i + 0.5) * size / output_size - 0.5
    value(i)     = sum over j of kernel(|j - position(i)| / stretch) * sample(j)

Without antialiasing, `stretch` is 1 and samples beyond the border repeat the last one. With it,
`stretch` is size / output_size if that shrinks, and the weights inside the border are normalised
to a sum of 1.
"""

from __future__ import annotations

import math
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
    """Interpolation kernel."""

    weigh: Callable[[NDArray[np.float64]], NDArray[np.float64]]
    """Maps distances in samples, not negative, to weights."""
    radius: int
    """Distance in samples at and beyond which the weight is 0."""


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
    """Resize (H, W, C) pixels to (height, width, C) float32, without rounding or clipping.

    Pixels that have the size already are returned unchanged.
    """
    input_height, input_width = pixels.shape[:2]
    # The axis first that leaves the smaller intermediate result.
    sizes = {0: height, 1: width}
    order = (0, 1) if height * input_width <= input_height * width else (1, 0)
    for axis in order:
        if pixels.shape[axis] != sizes[axis]:
            pixels = _resample_axis(pixels, axis, sizes[axis], kernel, antialias)
    return pixels


def _resample_axis(
    pixels: Pixels, axis: int, output_size: int, kernel: Kernel, antialias: bool
) -> NDArray[np.float32]:
    indices, weights = _axis_weights(pixels.shape[axis], output_size, kernel, antialias)
    shape = [1] * pixels.ndim
    shape[axis] = output_size
    total = np.zeros((*pixels.shape[:axis], output_size, *pixels.shape[axis + 1 :]), np.float32)
    for tap in range(indices.shape[1]):
        total += weights[:, tap].reshape(shape) * pixels.take(indices[:, tap], axis=axis)
    return total


def _axis_weights(
    size: int, output_size: int, kernel: Kernel, antialias: bool
) -> tuple[NDArray[np.intp], Weights]:
    """Return (output_size, taps) indices of the input samples, and their weights."""
    # In float32, as PyTorch: at a thousand pixels its positions are off by up to 1e-4.
    scale = np.float32(size) / np.float32(output_size)
    stretch = max(scale, np.float32(1)) if antialias else np.float32(1)
    half = np.float32(0.5)
    positions = (np.arange(output_size, dtype=np.float32) + half) * scale - half
    first = np.floor(positions - kernel.radius * stretch).astype(np.intp) + 1
    taps = first[:, np.newaxis] + np.arange(int(np.ceil(2 * kernel.radius * stretch)))
    weights = kernel.weigh(np.abs(taps - positions[:, np.newaxis]) / stretch)
    if antialias:
        weights = np.where((taps < 0) | (taps >= size), 0.0, weights)
        weights /= weights.sum(axis=1, keepdims=True)
    return taps.clip(0, size - 1), weights.astype(np.float32)


PATCH = 14  # pixels; of DINOv2
STRIDE = 32  # pixels; of convolutional backbones
MAX_ASPECT_RATIO = 4
ROUND14_MAX_PIXELS = 4_194_304  # 2048 x 2048: 21,316 patches with quadratic attention


@dataclass(frozen=True, slots=True)
class Preprocessing:
    """A named, versioned resize."""

    name: str
    version: int
    upright: bool
    """Whether EXIF orientation is applied first. The published preprocessings ignore it."""
    max_pixels: int
    """Maximum of height x width of the result"""
    typical_size: tuple[int, int]
    """Height and width of the usual result; for a 4 : 3 photo if the aspect ratio is kept."""
    resize: Callable[[Image.Image], Pixels]
    """A module-level function, because it is pickled for the decoding child processes."""

    def apply(self, image: Image.Image) -> Pixels:
        """Resize an RGB image.

        Returns:
            (H, W, 3) in 0 to 255: uint8, or float32 if interpolated numbers are not rounded;
            bicubic ones may be slightly outside of the range. H and W may depend on the photo.

        Raises:
            Unprocessable: `photo_too_small` if less than one patch is left; `too_many_pixels` if
                the preprocessing keeps the photo's size and that is too large for attention
                between all patches.
        """
        return self.resize(image)

    def as_spec(self) -> dict[str, str | int]:
        """Return the field `preprocessing` of the extractor spec."""
        return {"name": self.name, "version": self.version}


def squeeze_name(size: tuple[int, int], interpolation: str) -> str:
    """Return the name of the resize to (height, width), `bilinear` or `bicubic`."""
    suffix = "" if interpolation == "bilinear" else f"-{interpolation}"
    return f"resize{size[0]}x{size[1]}{suffix}"


def _squeeze(
    image: Image.Image,
    height: int,
    width: int,
    resampling: Image.Resampling = Image.Resampling.BILINEAR,
) -> Pixels:
    """Resize ignoring the aspect ratio: antialiased when shrinking, rounded."""
    return np.array(image.resize((width, height), resampling))  # writable, as PyTorch wants it


def _fit_area(image: Image.Image, height: int, width: int) -> Pixels:
    """Resize to about the area of height x width and the aspect ratio of the photo.

    Sides are multiples of 32, the stride of the deepest features. Aspect ratios beyond 4 : 1 are
    squeezed to it. Bilinear, antialiased when shrinking, rounded.
    """
    ratio = min(max(image.width / image.height, 1 / MAX_ASPECT_RATIO), MAX_ASPECT_RATIO)
    sides = math.sqrt(height * width / ratio), math.sqrt(height * width * ratio)
    height, width = (max(1, round(side / STRIDE)) * STRIDE for side in sides)
    return _squeeze(image, height, width)


def _native1024(image: Image.Image) -> Pixels:
    """Keep the photo's size; a longer side of more than 1024 pixels becomes 1024.

    The aspect ratio is kept. Bilinear, antialiased, rounded.
    """
    scale = min(1.0, 1024 / max(image.size))
    height, width = (max(1, round(side * scale)) for side in (image.height, image.width))
    return _squeeze(image, height, width)


def _demo1024(image: Image.Image) -> Pixels:
    """Resize as AnyLoc's demo/anyloc_vlad_generate.py does.

    A longer side of more than 1024 pixels becomes 1024, the other one is rounded down; then a
    centre crop to whole patches. Bicubic, not antialiased: torchvision's default for tensors until
    release 0.17, and AnyLoc's environment names 0.14.1.
    """
    width, height = image.size
    longest = max(width, height)
    if longest > 1024:
        height, width = int(height * 1024 / longest), int(width * 1024 / longest)
    _check_patches(image, height, width, "demo1024")
    return _centre_crop(resample(np.asarray(image), height, width, BICUBIC, antialias=False))


def _paper480x640(image: Image.Image) -> Pixels:
    """Resize as AnyLoc's scripts/dino_v2_vlad.py does on its data sets.

    480 x 640 ignoring the aspect ratio, bilinear, not antialiased as in `_demo1024`; then a centre
    crop to 476 x 630, which is 34 x 45 patches.
    """
    return _centre_crop(resample(np.asarray(image), 480, 640, BILINEAR, antialias=False))


def _round14(image: Image.Image) -> Pixels:
    """Resize as VPR-methods-evaluation does for AnyLoc.

    Each side to the nearest multiple of 14, ties to the even multiple; bilinear, antialiased.
    """
    height, width = (round(side / PATCH) * PATCH for side in (image.height, image.width))
    _check_patches(image, height, width, "round14")
    if height * width > ROUND14_MAX_PIXELS:
        raise Unprocessable(
            "too_many_pixels",
            f"The photo has {image.width} x {image.height} pixels; round14 keeps the size and "
            f"accepts up to {ROUND14_MAX_PIXELS} pixels. Make the photo smaller, or use demo1024.",
        )
    return resample(np.asarray(image), height, width, BILINEAR, antialias=True)


def _check_patches(image: Image.Image, height: int, width: int, name: str) -> None:
    if min(height, width) < PATCH:
        raise Unprocessable(
            "photo_too_small",
            f"The photo has {image.width} x {image.height} pixels, which {name} resizes to {width} "
            f"x {height}: less than one patch of {PATCH} x {PATCH}. Crop it, or use square224.",
        )


def _centre_crop(pixels: Pixels) -> Pixels:
    """Crop to whole patches around the centre; half-pixel offsets round to even."""
    height, width = (side // PATCH * PATCH for side in pixels.shape[:2])
    top, left = round((pixels.shape[0] - height) / 2), round((pixels.shape[1] - width) / 2)
    cropped: Pixels = pixels[top : top + height, left : left + width].copy()
    return cropped


def _area_preprocessing(height: int, width: int) -> Preprocessing:
    return Preprocessing(
        f"area{height}x{width}",
        1,
        True,
        2 * height * width,  # rounding a side to a multiple of STRIDE adds far less
        (height, width),
        partial(_fit_area, height=height, width=width),
    )


PREPROCESSINGS = {
    preprocessing.name: preprocessing
    for preprocessing in (
        Preprocessing(
            "square224", 1, True, 224 * 224, (224, 224), partial(_squeeze, height=224, width=224)
        ),
        Preprocessing(
            "square32", 1, True, 32 * 32, (32, 32), partial(_squeeze, height=32, width=32)
        ),
        _area_preprocessing(288, 384),
        Preprocessing("native1024", 1, True, 1024 * 1024, (768, 1024), _native1024),
        Preprocessing("demo1024", 1, False, 1022 * 1022, (756, 1022), _demo1024),
        Preprocessing("paper480x640", 1, False, 476 * 630, (476, 630), _paper480x640),
        Preprocessing("round14", 1, False, ROUND14_MAX_PIXELS, (770, 1022), _round14),
    )
}


def get_preprocessing(name: str) -> Preprocessing:
    """Return the preprocessing `name`.

    `resizeHEIGHTxWIDTH` and `resizeHEIGHTxWIDTH-bicubic` exist for every size.

    Raises Misconfigured (`unknown_preprocessing`).
    """
    if name in PREPROCESSINGS:
        return PREPROCESSINGS[name]
    size = re.fullmatch(r"resize([0-9]+)x([0-9]+)(-bicubic)?", name)
    if size is None:
        raise Misconfigured(
            "unknown_preprocessing",
            f"Unknown preprocessing {name!r}. Valid names: {', '.join(sorted(PREPROCESSINGS))}, "
            "resizeHEIGHTxWIDTH, resizeHEIGHTxWIDTH-bicubic.",
        )
    height, width = int(size[1]), int(size[2])
    resampling = Image.Resampling.BICUBIC if size[3] else Image.Resampling.BILINEAR
    return Preprocessing(
        name,
        1,
        True,
        height * width,
        (height, width),
        partial(_squeeze, height=height, width=width, resampling=resampling),
    )
