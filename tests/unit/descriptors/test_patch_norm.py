"""Patch-normalised thumbnails: unit rows that light does not change, and their sizes."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image

from shared.descriptors.extractor import Extractor
from shared.errors import Misconfigured
from shared.extractor_config.configs import get_extractor_config

NOISE = np.random.default_rng(0).integers(40, 160, (48, 96), dtype=np.uint8)


def describe(name: str, *photos: np.ndarray) -> np.ndarray:
    config = get_extractor_config(name, allow_test_extractors=False)
    extractor = Extractor(config, torch.device("cpu"))
    images = [Image.fromarray(photo).convert("RGB") for photo in photos]
    return extractor.describe([extractor.preprocessing.apply(image) for image in images], None)


def test_a_brighter_photo_of_more_contrast_has_the_same_row_and_another_view_has_not() -> None:
    brighter = (NOISE.astype(float) * 1.4 + 20).astype(np.uint8)
    first, same, other = describe("patchnorm", NOISE, brighter, NOISE[::-1])
    assert np.linalg.norm(first) == pytest.approx(1.0, abs=1e-5)
    assert first @ same > 0.99
    assert abs(first @ other) < 0.2


def test_a_black_photo_has_a_row_of_zeros_which_is_similar_to_nothing() -> None:
    assert not describe("patchnorm", np.zeros((32, 64), np.uint8)).any()


def test_the_size_of_a_thumbnail_is_an_option() -> None:
    assert describe("patchnorm", NOISE).shape == (1, 2048)
    assert describe("patchnorm:size=32x24", NOISE).shape == (1, 768)
    config = get_extractor_config("patchnorm:size=64x32", allow_test_extractors=False)
    assert config.name == "patchnorm"
    for size in ("30x32", "64", "0x4", "260x32", "4x-4"):
        with pytest.raises(Misconfigured, match="multiples of 4 up to 256"):
            get_extractor_config(f"patchnorm:size={size}", allow_test_extractors=False)
