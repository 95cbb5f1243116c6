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
def test_descriptors_are_different_unit_rows_of_the_requested_width(width: int) -> None:
    made = extractor(f"width={width}")
    pixels = pixels_of(made, range(4))
    rows = made.describe(pixels, None)
    assert rows.shape == (4, width)
    assert made.dimension(None) == width
    np.testing.assert_allclose(np.linalg.norm(rows.astype(float), axis=1), 1.0, atol=1e-4)
    assert width == 16 or (rows @ rows.T - np.eye(4)).max() < 0.8
    again = extractor(f"width={width},milliseconds=1")
    assert np.array_equal(again.describe(pixels, None), rows)


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
