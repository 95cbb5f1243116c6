"""What makes coordinates of poses in a `ReconstructedScene`: an alignment and a calibration."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from shared.geometry.cameras import Camera, Floats
from shared.geometry.frames import EastNorthUp, Similarity, rotation_of_vector
from shared.matching.features import LocalFeatures
from tests.support.reconstructed_scene import ReconstructedScene, looking

ORIGIN = EastNorthUp(45.07, 7.68, 240.0)
TURN_DEGREES = 30.0
"""The scene's y axis is this much west of north."""
SIMILARITY = Similarity(
    2.5,
    rotation_of_vector(np.array([0, 0, math.radians(TURN_DEGREES)])),
    np.array([4.0, -7.0, 2.0]),
    np.diag([1e-8] * 3 + [1e-4] * 3 + [1e-8]),
    np.zeros(3),
)
"""Its own error is a centimetre."""
ALIGNMENT: dict[str, Any] = {
    "origin": (ORIGIN.latitude, ORIGIN.longitude, ORIGIN.altitude_m),
    "similarity": SIMILARITY.as_json(),
    "rms_m": 0.5,
    "agreeing": 9,
    "located": 12,
    "is_on_line": False,
}
CALIBRATION = {
    "position_68": 1.5,
    "position_95": 2.5,
    "heading_68": 1.0,
    "heading_95": 2.0,
    "share_found": 0.9,
    "poses": 200,
}
CENTRE = np.array([0.4, 0.6, 0.1])
HEADING = 8.0
"""Of the query in the scene, from y to x"""


def take_query(scene: ReconstructedScene, camera: Camera | None = None) -> LocalFeatures:
    """The features of a photo that was taken at CENTRE, level, in the direction HEADING."""
    angle = math.radians(HEADING)
    ahead: Floats = CENTRE + np.array([math.sin(angle), math.cos(angle), 0])
    return scene.take(looking(CENTRE, ahead), CENTRE, camera)[0]
