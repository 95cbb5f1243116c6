"""Each detector of local features, and matches of its features, on a photo and a turned copy."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image
from skimage import data

from shared.errors import Misconfigured
from shared.matching.detectors import (
    DETECTORS,
    Detector,
    load_detector,
    load_tensors,
    read_package_weights,
)
from shared.matching.features import FULL_SIDE, MAX_KEYPOINTS, LocalFeatures
from shared.matching.matchers import MutualNearest
from shared.matching.verification import verify_matches
from shared.matching.xfeat import refine_keypoints

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
def detector_of(name: str) -> Detector:
    return load_detector(name, CPU)


@cache
def features_of(name: str, is_turned: bool = False) -> LocalFeatures:
    image = turned() if is_turned else photograph()
    return detector_of(name).detect([np.array(image)], [image.size])[0]


@pytest.mark.parametrize("name", DETECTORS)
class TestDetector:
    def test_keypoints_have_unit_descriptors_of_the_detectors_dimension(self, name: str) -> None:
        features = features_of(name)
        count, dimension = features.descriptors.shape
        assert 500 < count <= MAX_KEYPOINTS
        assert dimension == detector_of(name).dimension
        lengths = np.linalg.norm(features.descriptors.astype(float), axis=1) / 127
        np.testing.assert_allclose(lengths, 1, atol=0.03)
        assert features.positions.max() <= FULL_SIDE
        assert (features.width, features.height) == (SIDE, SIDE)

    def test_features_of_a_photo_take_at_most_140_kilobytes_and_survive_encoding(
        self, name: str
    ) -> None:
        features = features_of(name)
        encoded = features.encode()
        assert len(encoded) <= 16 + MAX_KEYPOINTS * (4 + detector_of(name).dimension) <= 140_000
        decoded = LocalFeatures.decode(encoded)
        np.testing.assert_array_equal(decoded.positions, features.positions)
        np.testing.assert_array_equal(decoded.descriptors, features.descriptors)

    @pytest.mark.parametrize("pixels", [np.zeros((8, 8, 3)), np.full((480, 640, 3), 200)])
    def test_a_tiny_photo_and_one_without_texture_have_no_keypoints(
        self, name: str, pixels: NDArray[np.float64]
    ) -> None:
        image = pixels.astype(np.uint8)
        (found,) = detector_of(name).detect([image], [(image.shape[1], image.shape[0])])
        assert found.descriptors.shape == (0, detector_of(name).dimension)

    def test_a_photo_has_the_same_features_in_a_batch_with_others(
        self, name: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        # As on a GPU, where more than one photo fits into a pass.
        monkeypatch.setattr(detector_of(name)._limit, "_max_pixels", math.inf)
        blank = np.full((SIDE, SIDE, 3), 200, np.uint8)
        images = [np.array(photograph()), blank, np.array(turned()), np.array(photograph())[:300]]
        found = detector_of(name).detect(images, [image.shape[1::-1] for image in images])
        for features, alone in ((found[0], features_of(name)), (found[2], features_of(name, True))):
            np.testing.assert_allclose(features.positions[:100], alone.positions[:100], atol=2)
            np.testing.assert_allclose(features.descriptors[:100], alone.descriptors[:100], atol=2)
        assert len(found[1].positions) == 0
        assert found[3].height == 300

    def test_the_model_is_named_by_the_detector_and_the_hash_of_its_weights(
        self, name: str
    ) -> None:
        detector, _, sha256 = detector_of(name).model.partition("@")
        assert (detector, len(sha256)) == (name, 12)


def matcher_of(detector: str) -> MutualNearest:
    return MutualNearest.of_model(detector_of(detector).model)


@pytest.mark.parametrize("detector", DETECTORS)
class TestMatches:
    def test_verified_matches_show_the_same_points(self, detector: str) -> None:
        first, second = features_of(detector), features_of(detector, is_turned=True)
        matches = matcher_of(detector).match(first, second)
        points = [first.working_pixels()[matches[:, 0]], second.working_pixels()[matches[:, 1]]]
        inliers = verify_matches(*points)
        assert inliers.sum() >= 100
        right = first.pixels()[matches[inliers, 0]], second.pixels()[matches[inliers, 1]]
        errors = np.linalg.norm(turn(right[0]) - right[1], axis=1)
        assert np.mean(errors < 3) > 0.9

    def test_each_keypoint_is_matched_at_most_once(self, detector: str) -> None:
        first, second = features_of(detector), features_of(detector, is_turned=True)
        matches = matcher_of(detector).match(first, second)
        for column in matches.T:
            assert len(set(column.tolist())) == len(matches)

    def test_a_photo_without_keypoints_matches_nothing(self, detector: str) -> None:
        features = features_of(detector)
        empty = LocalFeatures.empty((64, 48), features.descriptors.shape[1])
        matcher = matcher_of(detector)
        assert matcher.match(features, empty).shape == (0, 2)
        assert matcher.match(empty, features).shape == (0, 2)


def test_fewer_matches_than_a_fundamental_matrix_takes_have_no_inliers() -> None:
    points = np.random.default_rng(0).uniform(0, 640, (7, 2))
    assert not verify_matches(points, points + 3).any()


def test_points_that_move_at_random_have_few_inliers() -> None:
    rng = np.random.default_rng(0)
    inliers = verify_matches(rng.uniform(0, 640, (200, 2)), rng.uniform(0, 640, (200, 2)))
    assert inliers.sum() < 40


def test_an_unknown_detector_is_refused_with_the_known_ones() -> None:
    with pytest.raises(Misconfigured, match=r"LOCAL_FEATURES is one of: xfeat, aliked-n16"):
        load_detector("sift", CPU)


def test_missing_weights_name_the_extra_that_installs_them() -> None:
    with pytest.raises(Misconfigured, match=r"'\.\[lightglue\]'"):
        read_package_weights("scm_no_such_package", "weights.pth", "lightglue")


@pytest.mark.parametrize(
    "state", [{}, {"weight": torch.zeros(3, 3), "bias": torch.zeros(2), "other": torch.zeros(1)}]
)
def test_weights_that_do_not_fit_are_refused(state: dict[str, torch.Tensor]) -> None:
    with pytest.raises(Misconfigured) as caught:
        load_tensors(torch.nn.Linear(2, 2), state)
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
