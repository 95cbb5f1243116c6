"""The motion of a track, and its state at the pose of a frame."""

from __future__ import annotations

from dataclasses import replace
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from services.gateway.tracks.schemas import TrackParams, track_state_response
from shared.geodesy import EARTH_RADIUS_M
from shared.tracks.evidence import PositionFix
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


def test_the_state_of_a_frame_is_at_its_pose_unless_the_track_is_elsewhere() -> None:
    track_filter = TrackFilter(line_map(PHOTOS))
    belief = track_filter.advance(None, pointing_at(5, PHOTOS, 0))
    state = replace(track_filter.state(belief), photo=str(UUID(int=5)))
    degrees = np.degrees(1 / EARTH_RADIUS_M)

    def pose(east_m: float) -> PositionFix:
        return PositionFix(
            latitude=0.0, longitude=east_m * degrees, accuracy_m=0.3, radius_95_m=0.7, heading=92.5
        )

    there = track_state_response(state, pose(52))
    assert (there.longitude, there.heading) == (52 * degrees, 92.5)
    assert (there.radius_68_m, there.radius_95_m) == (0.3, 0.7)
    without = track_state_response(state, None)
    assert without.heading == 90
    assert track_state_response(state, pose(400)) == without
    gps = PositionFix(latitude=0.0, longitude=52 * degrees, accuracy_m=0.3)
    assert track_state_response(state, gps) == without
