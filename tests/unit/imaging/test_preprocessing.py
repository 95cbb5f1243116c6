"""Preprocessings: the published ones held to torchvision's own operations, in the order published.

Each reference scales to [0, 1], normalises, and then resizes the normalised tensor. Ours resizes
first and leaves the normalising to the backbone: the numbers must come out the same.
"""

from __future__ import annotations

import functools

import numpy as np
import pytest
import torch
from PIL import Image
from torchvision.transforms import InterpolationMode
from torchvision.transforms import functional as F  # noqa: N812

from shared.descriptors.backbones import normalise_pixels
from shared.descriptors.backbones.dinov2 import MEAN, STD
from shared.errors import Misconfigured, Unprocessable
from shared.imaging.preprocessing import (
    BICUBIC,
    BILINEAR,
    PREPROCESSINGS,
    Kernel,
    get_preprocessing,
    resample,
)

# Height, width: landscape, portrait, square, beyond 1024 either way, odd differences to crop.
SIZES = [(480, 640), (768, 500), (224, 224), (1100, 1500), (1801, 1201), (333, 447), (14, 29)]
# Of normalised numbers, which reach from -2.2 to 2.7. PyTorch rounds places to float32, and fuses
# steps in which they are found: here and there a weight differs by 1e-4.
FARTHEST, ON_AVERAGE = 1e-4, 1e-6


@functools.cache
def photo(height: int, width: int) -> Image.Image:
    """Noise over a gradient: every mistake in a place or a weight shows."""
    rng = np.random.default_rng(height * width)
    slope = np.linspace(0, 120, height * width * 3).reshape(height, width, 3)
    return Image.fromarray((slope + rng.integers(0, 136, slope.shape)).astype(np.uint8))


def normalised(image: Image.Image) -> torch.Tensor:
    tensor: torch.Tensor = F.normalize(F.to_tensor(image), list(MEAN), list(STD))
    return tensor


def middle(tensor: torch.Tensor, height: int, width: int) -> torch.Tensor:
    cropped: torch.Tensor = F.center_crop(tensor, [height, width])
    return cropped


def demo1024(image: Image.Image) -> torch.Tensor:
    tensor = normalised(image)
    height, width = tensor.shape[1:]
    if height >= width and height > 1024:
        size = [1024, int(width * 1024 / height)]
    elif width > 1024:
        size = [int(height * 1024 / width), 1024]
    else:
        size = [height, width]
    tensor = F.resize(tensor, size, InterpolationMode.BICUBIC, antialias=False)
    return middle(tensor, size[0] // 14 * 14, size[1] // 14 * 14)


def paper480x640(image: Image.Image) -> torch.Tensor:
    return middle(F.resize(normalised(image), [480, 640], antialias=False), 476, 630)


def round14(image: Image.Image) -> torch.Tensor:
    tensor = normalised(image)
    sides = [round(side / 14) * 14 for side in tensor.shape[1:]]
    resized: torch.Tensor = F.resize(tensor, sides, antialias=True)
    return resized


PUBLISHED = {"demo1024": demo1024, "paper480x640": paper480x640, "round14": round14}


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("name", PUBLISHED)
def test_published_preprocessings_give_the_published_pixel_values(
    name: str, size: tuple[int, int]
) -> None:
    image = photo(*size)
    pixels = get_preprocessing(name).apply(image)
    assert pixels.shape[0] % 14 == pixels.shape[1] % 14 == 0
    assert pixels.shape[0] * pixels.shape[1] <= get_preprocessing(name).max_pixels
    ours = normalise_pixels(torch.from_numpy(np.stack([pixels])), MEAN, STD)[0]
    expected = PUBLISHED[name](image)
    assert ours.shape == expected.shape
    differences = (ours - expected).abs()
    assert float(differences.max()) < FARTHEST
    assert float(differences.mean()) < ON_AVERAGE


@pytest.mark.parametrize(
    ("size", "expected"),
    [
        ((480, 640), (288, 384)),
        ((640, 480), (384, 288)),
        ((1080, 1920), (256, 448)),
        ((32, 64), (224, 480)),
        ((100, 100), (320, 320)),
        ((10, 5000), (160, 672)),
        ((1, 1), (320, 320)),
    ],
)
def test_area_preprocessing_keeps_the_aspect_ratio_up_to_4_to_1(
    size: tuple[int, int], expected: tuple[int, int]
) -> None:
    height, width = size
    found = get_preprocessing("area288x384")
    pixels = found.apply(Image.new("RGB", (width, height)))
    assert pixels.shape == (*expected, 3)
    assert pixels.shape[0] * pixels.shape[1] <= found.max_pixels


def test_photos_of_the_target_size_are_not_resampled() -> None:
    pixels = get_preprocessing("demo1024").apply(photo(480, 640))
    assert pixels.dtype == np.uint8
    np.testing.assert_array_equal(pixels, np.asarray(photo(480, 640))[2:478, 5:635])


def test_cubic_overshoot_is_neither_clipped_nor_rounded() -> None:
    edges = Image.fromarray(np.tile(np.array([0, 255], np.uint8).repeat(8), (60, 125)))
    pixels = get_preprocessing("demo1024").apply(edges.convert("RGB"))
    assert pixels.dtype == np.float32
    assert pixels.min() < -5
    assert pixels.max() > 260


@pytest.mark.parametrize("name", ["square224", "square32"])
def test_square_preprocessing_equals_pillows_resizing(name: str) -> None:
    side = int(name.removeprefix("square"))
    for size in [*SIZES, (10, 20_000)]:
        expected = photo(*size).resize((side, side), Image.Resampling.BILINEAR)
        pixels = get_preprocessing(name).apply(photo(*size))
        assert pixels.dtype == np.uint8
        np.testing.assert_array_equal(pixels, np.asarray(expected))


def test_versions_are_those_that_stored_descriptors_were_made_with() -> None:
    assert get_preprocessing("square224").as_spec() == {"name": "square224", "version": 1}
    for name, found in PREPROCESSINGS.items():
        assert found.as_spec()["name"] == name


@pytest.mark.parametrize(
    ("name", "size"), [("demo1024", (13, 200)), ("demo1024", (10, 20_000)), ("round14", (7, 99))]
)
def test_photo_without_a_whole_patch_is_refused(name: str, size: tuple[int, int]) -> None:
    with pytest.raises(Unprocessable, match=f"{size[1]} x {size[0]} pixels") as caught:
        get_preprocessing(name).apply(Image.new("RGB", (size[1], size[0])))
    assert caught.value.code == "photo_too_small"


def test_preprocessing_without_resizing_limits_the_photo_size() -> None:
    with pytest.raises(Unprocessable, match="demo1024") as caught:
        get_preprocessing("round14").apply(Image.new("RGB", (2100, 2100)))
    assert caught.value.code == "too_many_pixels"


def test_unknown_name_is_refused_with_the_known_ones() -> None:
    with pytest.raises(Misconfigured, match=r"demo1024.*square224") as caught:
        get_preprocessing("demo512")
    assert caught.value.code == "unknown_preprocessing"


@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize("onto", [(20, 30), (41, 59), (40, 60), (97, 13), (3, 200), (1, 1)])
def test_resampling_equals_pytorchs_interpolation(onto: tuple[int, int], antialias: bool) -> None:
    pixels = np.random.default_rng(1).random((40, 60, 3), dtype=np.float32)
    modes: list[tuple[str, Kernel]] = [("bilinear", BILINEAR)]
    if not antialias:  # antialiased, PyTorch's cubic is another one (a = -0.5)
        modes.append(("bicubic", BICUBIC))
    for mode, kernel in modes:
        expected = torch.nn.functional.interpolate(
            torch.from_numpy(pixels).permute(2, 0, 1)[np.newaxis],
            size=onto,
            mode=mode,
            antialias=antialias,
        )[0].permute(1, 2, 0)
        ours = resample(pixels, *onto, kernel, antialias=antialias)
        np.testing.assert_allclose(ours, expected, atol=5e-6, err_msg=mode)
