"""Projection, and focal lengths of EXIF."""

from __future__ import annotations

from typing import Any

import numpy as np
import poselib
import pycolmap
import pytest

from shared.geometry.cameras import CAMERA_PARAMETERS, Camera, focal_length_from_exif


def test_camera_projects_as_poselib_does() -> None:
    camera = Camera(1280, 720, 900.0, radial=-0.1)
    points = np.random.default_rng(0).uniform((-2, -2, 4), (2, 2, 9), (20, 3))
    ours = camera.project(points)
    described = camera.as_poselib()
    theirs = poselib.Camera(
        described["model"], described["params"], described["width"], described["height"]
    )
    np.testing.assert_allclose(theirs.project(points[:, :2] / points[:, 2:]), ours, rtol=1e-9)


def test_resized_photo_has_the_same_view() -> None:
    camera = Camera(4000, 3000, 3200.0, 0.02)
    points = np.array([[0.3, -0.2, 1.0]])
    np.testing.assert_allclose(
        camera.resized(1000, 750).project(points), camera.project(points) / 4
    )


@pytest.mark.parametrize(
    ("exif", "expected"),
    [
        ({"focal_35mm": 36.0, "size": (6000, 4000)}, 1.0),
        ({"focal_35mm": 36.0, "size": (4000, 6000)}, 1.0),
        ({"focal_35mm": 26.0, "size": (4032, 3024)}, 0.7511),
        ({"focal_mm": 50.0, "plane": (5000 / 36 * 25.4, 2), "size": (5000, 3333)}, 50 / 36),
        ({"focal_mm": 50.0, "plane": (5000 / 3.6, 3), "size": (5000, 3333)}, 50 / 36),
        ({"focal_mm": 50.0, "size": (5000, 3333)}, None),
        ({"focal_mm": 50.0, "plane": (1000.0, 7), "size": (5000, 3333)}, None),
        ({"focal_35mm": 0.0, "size": (5000, 3333)}, None),
        ({"focal_35mm": 5.0, "size": (5000, 3333)}, None),
        ({"focal_35mm": 50_000.0, "size": (5000, 3333)}, None),
        ({"size": (5000, 3333)}, None),
    ],
)
def test_focal_length_is_read_from_exif(exif: dict[str, Any], expected: float | None) -> None:
    width, height = exif["size"]
    resolution, unit = exif.get("plane", (None, None))
    found = focal_length_from_exif(
        width, height, exif.get("focal_35mm"), exif.get("focal_mm"), resolution, unit
    )
    assert found == (expected if expected is None else pytest.approx(expected, rel=1e-3))


@pytest.mark.parametrize("model", CAMERA_PARAMETERS)
def test_camera_of_parameters_sees_as_that_of_pycolmap_does(model: str) -> None:
    theirs = pycolmap.Camera.create_from_model_name(1, model, 420.0, 640, 480)
    params = np.array(theirs.params)
    params[theirs.principal_point_idxs()] += (14, -9)
    extra = theirs.extra_params_idxs()
    params[extra] = np.linspace(0.02, -0.03, len(extra))
    theirs.params = params.tolist()
    ours = Camera.of_parameters(model, params.tolist(), (640, 480))
    pixels = np.random.default_rng(0).uniform((5, 5), (635, 475), (50, 2))
    seen = np.array(theirs.cam_from_img(pixels)) * ours.focal_pixels + (320, 240)
    np.testing.assert_allclose(ours.undistort(pixels), seen, atol=0.02)
