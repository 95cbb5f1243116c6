"""The descriptors without a network."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from lab.cli.datasets.baselines import BASELINE_DESCRIPTORS, average_colour, thumbnail
from tests.support.photos import photo_image


@pytest.mark.parametrize("name", BASELINE_DESCRIPTORS)
def test_descriptor_is_a_unit_vector_and_most_like_itself(name: str) -> None:
    rows = np.stack([BASELINE_DESCRIPTORS[name](photo_image(number)) for number in range(6)])
    assert np.linalg.norm(rows, axis=1) == pytest.approx(1, abs=1e-5)
    assert (rows @ rows.T).argmax(axis=1).tolist() == list(range(6))


def test_average_colour_prefers_the_nearer_colour() -> None:
    expected, near, far = (
        average_colour(Image.new("RGB", (8, 8), colour))
        for colour in ((120, 90, 60), (126, 96, 66), (60, 90, 120))
    )
    assert expected @ near > expected @ far


def test_thumbnail_is_blind_to_brightness_and_contrast() -> None:
    photo = photo_image(3)
    duller = photo.point(lambda value: 40 + value // 2)
    assert thumbnail(photo) @ thumbnail(duller) == pytest.approx(1, abs=1e-3)
    assert not thumbnail(Image.new("RGB", (32, 32), (9, 9, 9))).any(), "one colour has no contrast"
