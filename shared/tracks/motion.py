"""Motion models: how fast a camera moves through the map."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass

from shared.errors import InvalidRequest

TYPICAL_SHARE = 0.4
"""Typical speed of a motion model that is given by its maximum, as a share of the maximum"""


@dataclass(frozen=True, slots=True)
class MotionModel:
    """Speeds of a kind of motion in metres per second."""

    name: str
    typical_speed_mps: float
    max_speed_mps: float


MOTION_MODELS = {
    model.name: model
    for model in (
        MotionModel("walk", 1.4, 3.0),
        MotionModel("bicycle", 5.0, 12.0),
        MotionModel("car", 12.0, 40.0),
        MotionModel("train", 30.0, 90.0),
    )
}
DEFAULT_MOTION = MOTION_MODELS["car"]


def motion_model(motion: str | float) -> MotionModel:
    """Return a motion model by its name, or by its maximum speed in metres per second.

    Raises:
        ValueError: An unknown name, or a speed that is not positive and finite.
    """
    if isinstance(motion, str) and motion in MOTION_MODELS:
        return MOTION_MODELS[motion]
    try:
        speed = float(motion)
    except ValueError:
        speed = math.nan
    if not (math.isfinite(speed) and speed > 0):
        raise ValueError(
            f"The motion must be {', '.join(MOTION_MODELS)} or a maximum speed in m/s above 0, "
            f"not {motion!r}."
        )
    # A positive number times a share may be rounded to 0, by which no distance can be divided.
    typical = max(speed * TYPICAL_SHARE, sys.float_info.min)
    return MotionModel(f"{speed:g}", typical, speed)


def parse_motion(text: str) -> MotionModel:
    """Parse `walk`, `bicycle`, `car`, `train` or a maximum speed.

    Raises:
        InvalidRequest: `bad_motion`.
    """
    try:
        return motion_model(text)
    except ValueError as error:
        raise InvalidRequest("bad_motion", str(error)) from error
