"""Tracks on a real railway ride, winter on summer: what they find, and what they claim."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from lab.datasets.open_dataset import open_evaluation_set
from lab.evaluation.sequences import evaluate_sequence, prepare_map, sequence_figures
from shared.descriptors.extractor import Extractor
from shared.extractor_config.configs import get_extractor_config
from shared.tracks.motion import MOTION_MODELS

pytestmark = pytest.mark.real_photos

TRAIN = MOTION_MODELS["train"]
FIRST = 25
"""Before it, the photos of the map are black: nothing can be found there."""


@pytest.fixture(scope="module")
def ride(real_photos: Path) -> Any:
    """The evaluation set, its map and the descriptors of its queries."""
    found = open_evaluation_set(real_photos / "rides")
    extractor = Extractor(
        get_extractor_config("patchnorm", allow_test_extractors=False), torch.device("cpu")
    )
    rows = [
        extractor.describe(
            [extractor.preprocessing.apply(Image.open(p.path).convert("RGB")) for p in photos], None
        )
        for photos in (found.database, found.queries)
    ]
    return found, prepare_map(found, rows[0], TRAIN), rows[1]


@pytest.mark.parametrize("pace", [0.75, 1.5])
def test_a_real_ride_in_winter_is_followed_through_summer_at_any_pace(
    ride: Any, pace: float
) -> None:
    found, map_, rows = ride
    members = [int(n) for n in np.arange(FIRST, 600, pace)]
    frames, _ = evaluate_sequence(map_, found, members, rows[members], TRAIN)
    figures = sequence_figures([frames])
    recall = figures["recall"]
    assert recall["filter"] > 0.9 > recall["single"]
    assert figures["tracking"] > 0.8
    assert figures["tracking_precision"] > 0.95
    assert figures["calibration_error"] < 0.08
    assert figures["frames_to_localise"][0] <= 20


def test_a_train_that_stands_where_the_one_of_the_map_did_not_stays_where_it_is(ride: Any) -> None:
    found, map_, rows = ride
    members = [*range(370, 420), *[420] * 30, *range(420, 470)]
    frames, _ = evaluate_sequence(map_, found, members, rows[members], TRAIN)
    figures = sequence_figures([frames])
    assert figures["tracking_precision"] > 0.95
    assert np.mean([frame.filter_is_right for frame in frames[30:]]) > 0.9


def test_a_kidnapped_camera_is_relocalised_on_a_real_ride(ride: Any) -> None:
    found, map_, rows = ride
    for before, after in ((100, 700), (900, 300), (500, 1000)):
        members = [*range(before, before + 60), *range(after, after + 60)]
        frames, _ = evaluate_sequence(map_, found, members, rows[members], TRAIN)
        assert all(frame.filter_is_right for frame in frames[100:])
