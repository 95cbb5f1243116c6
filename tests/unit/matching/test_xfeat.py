"""Local features, and their matches, of a photo and a turned copy."""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image
from skimage import data

from shared.errors import Misconfigured
from shared.matching import xfeat
from shared.matching.features import FULL_SIDE, MAX_KEYPOINTS, LocalFeatures
from shared.matching.mutual_nearest import match_keypoints
from shared.matching.verification import verify_matches
from shared.matching.xfeat import DIMENSION, XFeatDetector, load_detector, refine_keypoints

CPU = torch.device("cpu")
ANGLE_DEGREES = 8.0
SIDE = 512


def photograph() -> Image.Image:
    pixels: NDArray[np.uint8] = data.astronaut()  # type: ignore[no-untyped-call]
    return Image.fromarray(pixels)


def turned() -> Image.Image:
    return photograph().rotate(ANGLE_DEGREES, Image.Resampling.BICUBIC)


def turn(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where `turned` shows points of the photograph."""
    radians, middle = math.radians(ANGLE_DEGREES), SIDE / 2
    x, y = (points - middle).T
    cosine, sine = math.cos(radians), math.sin(radians)
    return np.column_stack([cosine * x + sine * y, -sine * x + cosine * y]) + middle


@cache
def detector() -> XFeatDetector:
    return load_detector(CPU)


@cache
def features(is_turned: bool = False) -> LocalFeatures:
    image = turned() if is_turned else photograph()
    return detector().detect([np.array(image)], [image.size])[0]


def test_keypoints_have_unit_descriptors() -> None:
    count, dimension = features().descriptors.shape
    assert 500 < count <= MAX_KEYPOINTS
    assert dimension == DIMENSION
    lengths = np.linalg.norm(features().descriptors.astype(float), axis=1) / 127
    np.testing.assert_allclose(lengths, 1, atol=0.03)
    assert features().positions.max() <= FULL_SIDE
    assert (features().width, features().height) == (SIDE, SIDE)


def test_features_of_a_photo_take_at_most_70_kilobytes_and_survive_encoding() -> None:
    encoded = features().encode()
    assert len(encoded) <= 16 + MAX_KEYPOINTS * (4 + DIMENSION) <= 70_000
    decoded = LocalFeatures.decode(encoded)
    np.testing.assert_array_equal(decoded.positions, features().positions)
    np.testing.assert_array_equal(decoded.descriptors, features().descriptors)


@pytest.mark.parametrize("pixels", [np.zeros((8, 8, 3)), np.full((480, 640, 3), 200)])
def test_a_tiny_photo_and_one_without_texture_have_no_keypoints(
    pixels: NDArray[np.float64],
) -> None:
    image = pixels.astype(np.uint8)
    (found,) = detector().detect([image], [(image.shape[1], image.shape[0])])
    assert found.descriptors.shape == (0, DIMENSION)


def test_a_photo_has_the_same_features_in_a_batch_with_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # As on a GPU, where more than one photo fits into a pass.
    monkeypatch.setattr(detector()._limit, "_max_pixels", math.inf)
    blank = np.full((SIDE, SIDE, 3), 200, np.uint8)
    images = [np.array(photograph()), blank, np.array(turned()), np.array(photograph())[:300]]
    found = detector().detect(images, [image.shape[1::-1] for image in images])
    for one, alone in ((found[0], features()), (found[2], features(is_turned=True))):
        np.testing.assert_allclose(one.positions[:100], alone.positions[:100], atol=2)
        np.testing.assert_allclose(one.descriptors[:100], alone.descriptors[:100], atol=2)
    assert len(found[1].positions) == 0
    assert found[3].height == 300


def test_the_model_is_named_by_the_detector_and_the_hash_of_its_weights() -> None:
    name, _, sha256 = detector().model.partition("@")
    assert (name, len(sha256)) == ("xfeat", 12)


def test_verified_matches_show_the_same_points() -> None:
    first, second = features(), features(is_turned=True)
    matches = match_keypoints(first, second)
    points = [first.working_pixels()[matches[:, 0]], second.working_pixels()[matches[:, 1]]]
    inliers = verify_matches(*points)
    assert inliers.sum() >= 100
    right = first.pixels()[matches[inliers, 0]], second.pixels()[matches[inliers, 1]]
    errors = np.linalg.norm(turn(right[0]) - right[1], axis=1)
    assert np.mean(errors < 3) > 0.9


def test_each_keypoint_is_matched_at_most_once() -> None:
    matches = match_keypoints(features(), features(is_turned=True))
    for column in matches.T:
        assert len(set(column.tolist())) == len(matches)


def test_a_photo_without_keypoints_matches_nothing() -> None:
    empty = LocalFeatures.empty((64, 48), DIMENSION)
    assert match_keypoints(features(), empty).shape == (0, 2)
    assert match_keypoints(empty, features()).shape == (0, 2)


def test_fewer_matches_than_a_fundamental_matrix_takes_have_no_inliers() -> None:
    points = np.random.default_rng(0).uniform(0, 640, (7, 2))
    assert not verify_matches(points, points + 3).any()


def test_points_that_move_at_random_have_few_inliers() -> None:
    rng = np.random.default_rng(0)
    inliers = verify_matches(rng.uniform(0, 640, (200, 2)), rng.uniform(0, 640, (200, 2)))
    assert inliers.sum() < 40


def test_missing_weights_name_the_extra_that_installs_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(xfeat, "PACKAGE", "scm_no_such_package")
    with pytest.raises(Misconfigured, match=r"scm-no-such-package.*'\.\[extractor\]'") as caught:
        XFeatDetector(CPU)
    assert caught.value.code == "weights_missing"


@pytest.mark.parametrize("state", [{}, {"other": torch.zeros(1)}])
def test_weights_that_do_not_fit_are_refused(
    state: dict[str, torch.Tensor], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    torch.save(state, tmp_path / "xfeat.pt")
    monkeypatch.setattr(xfeat, "_find_weights", lambda: tmp_path / "xfeat.pt")
    with pytest.raises(Misconfigured) as caught:
        XFeatDetector(CPU)
    assert caught.value.code == "weights_unusable"


@pytest.mark.parametrize("data", [b"", bytes(15), bytes(16), b"\1" * 40])
def test_damaged_features_are_no_features(data: bytes) -> None:
    with pytest.raises(ValueError, match="bytes"):
        LocalFeatures.decode(data)


def test_keypoints_of_xfeat_are_at_the_peak_of_its_response() -> None:
    y, x = torch.meshgrid(torch.arange(16.0), torch.arange(24.0), indexing="ij")
    response = -((x - 10.3) ** 2) - 2 * (y - 7.8) ** 2
    for scale in (1.0, 1.5):  # of the photo, which the network resizes to 24 x 16
        size = round(16 * scale), round(24 * scale)
        keypoints = torch.tensor([[10.0, 8.0], [0.0, 8.0]]) * scale
        peak, border = refine_keypoints(keypoints, response, size)
        assert peak.tolist() == pytest.approx([10.8 * scale - 0.5, 8.3 * scale - 0.5], abs=1e-4)
        assert border.tolist() == pytest.approx([0.5 * scale - 0.5, 8.5 * scale - 0.5], abs=1e-4)
