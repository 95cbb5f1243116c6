"""The motion of a track: the default, and a maximum speed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.gateway.tracks.schemas import TrackParams
from shared.tracks.filter import TrackFilter
from shared.tracks.motion import MOTION_MODELS, TYPICAL_SHARE, MotionModel
from tests.unit.tracks.maps import line_map, pointing_at

PHOTOS = 60  # 10 m apart


def followed(track_filter: TrackFilter) -> NDArray[np.float64]:
    """The probabilities of a camera that moves 20 m/s along the street."""
    belief = None
    for second in range(0, 12, 2):
        belief = track_filter.advance(belief, pointing_at(4 * second // 2 + 5, PHOTOS, second))
    assert belief is not None
    return belief.probabilities


def test_a_track_without_a_motion_moves_as_a_car() -> None:
    assert TrackParams().motion_model() == MOTION_MODELS["car"]
    default, car, walk = (
        followed(track_filter)
        for track_filter in (
            TrackFilter(line_map(PHOTOS)),
            TrackFilter(line_map(PHOTOS), MOTION_MODELS["car"]),
            TrackFilter(line_map(PHOTOS), MOTION_MODELS["walk"]),
        )
    )
    np.testing.assert_array_equal(default, car)
    assert default.max() > walk.max(), "20 m/s is no walk"


def test_a_speed_is_a_motion_whose_typical_speed_is_a_share_of_it() -> None:
    assert TrackParams(max_speed_mps=20).motion_model() == MotionModel("20", 20 * TYPICAL_SHARE, 20)
