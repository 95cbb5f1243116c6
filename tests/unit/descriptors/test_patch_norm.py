"""Patch-normalised thumbnails: unit rows that light does not change."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image

from shared.descriptors.extractor import Extractor
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
    assert first.shape == (2048,)
    assert np.linalg.norm(first) == pytest.approx(1.0, abs=1e-5)
    assert first @ same > 0.99
    assert abs(first @ other) < 0.2


def test_a_black_photo_has_a_row_of_zeros_which_is_similar_to_nothing() -> None:
    assert not describe("patchnorm", np.zeros((32, 64), np.uint8)).any()
