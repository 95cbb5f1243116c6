"""The backbone that takes time: as long as its name says, and its descriptors tell photos apart."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from shared.descriptors.extractor import Extractor
from shared.extractor_config.configs import get_extractor_config
from tests.support.photos import photo_image

WIDTHS = (16, 7168, 98_304)


def extractor(options: str) -> Extractor:
    config = get_extractor_config(f"test-slow-avg:{options}", allow_test_extractors=True)
    return Extractor(config, torch.device("cpu"))


def pixels_of(made: Extractor, numbers: range) -> NDArray[np.uint8]:
    return np.stack([made.preprocessing.apply(photo_image(number)) for number in numbers])


@pytest.mark.parametrize("width", WIDTHS)
def test_descriptors_are_unit_rows_of_the_requested_width(width: int) -> None:
    made = extractor(f"width={width}")
    rows = made.describe(pixels_of(made, range(4)), None)
    assert rows.shape == (4, width)
    assert made.dimension(None) == width
    np.testing.assert_allclose(np.linalg.norm(rows.astype(float), axis=1), 1.0, atol=1e-4)


@pytest.mark.parametrize("width", WIDTHS[1:])
def test_different_photos_have_different_descriptors(width: int) -> None:
    made = extractor(f"width={width}")
    rows = made.describe(pixels_of(made, range(50)), None)
    between = rows @ rows.T - np.eye(len(rows))
    assert between.max() < 0.8


def test_another_process_makes_the_same_descriptors() -> None:
    one, other = extractor("width=7168"), extractor("width=7168,milliseconds=1")
    pixels = pixels_of(one, range(3))
    assert np.array_equal(one.describe(pixels, None), other.describe(pixels, None))
    assert one.backbone.fingerprint == other.backbone.fingerprint
    assert one.backbone.fingerprint != extractor("width=98304").backbone.fingerprint


@pytest.mark.parametrize("grey", [0, 127, 128, 255])
def test_photo_of_one_colour_has_a_direction(grey: int) -> None:
    made = extractor("width=7168")
    rows = made.describe(np.full((1, 224, 224, 3), grey, np.uint8), None)
    assert np.linalg.norm(rows.astype(float)) == pytest.approx(1.0, abs=1e-4)


def test_it_sleeps_for_every_photo(monkeypatch: pytest.MonkeyPatch) -> None:
    slept: list[float] = []
    sleep, this_thread = time.sleep, threading.get_ident()

    def record(seconds: float) -> None:
        # Threads of other tests may still be ending.
        slept.append(seconds) if threading.get_ident() == this_thread else sleep(seconds)

    monkeypatch.setattr(time, "sleep", record)
    made = extractor("milliseconds=250")
    made.describe(pixels_of(made, range(4)), None)
    assert sum(slept) == 1.0
