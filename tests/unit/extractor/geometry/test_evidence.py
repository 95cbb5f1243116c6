"""Matches and blocks of photos that contradict the photos' coordinates."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from services.extractor.geometry.evidence import (
    CONTRADICTED,
    NO_MATCHES,
    UNCONNECTED,
    agreeing_pairs,
    explain_left_out,
    find_misplaced,
)
from services.extractor.geometry.matching import VerifiedMatches, match_pairs
from services.extractor.geometry.pycolmap_models import PhotoToMap
from shared.geometry.frames import rotation_of_vector
from tests.support.reconstructed_scene import ReconstructedScene, looking

PHOTOS = 12
STREET_M = 70.0
"""Between the two streets, whose facades are the same"""
TURN = rotation_of_vector(np.array([0.2, 0.4, 1.0]))


@pytest.fixture(scope="module")
def scene() -> ReconstructedScene:
    return ReconstructedScene(photos=PHOTOS)


@pytest.fixture(scope="module")
def matches(scene: ReconstructedScene) -> VerifiedMatches:
    pairs = np.array([(i, j) for j in range(PHOTOS) for i in range(j)], np.int32)
    return match_pairs(scene.features, pairs, lambda _: None)


def photos_at(scene: ReconstructedScene, positions: np.ndarray) -> list[PhotoToMap]:
    return [
        PhotoToMap(photo, f.width, f.height, f.pixels().astype(np.float32), 500 / 640, place)
        for (photo, f), place in zip(scene.features.items(), positions, strict=True)
    ]


def weaker_between_streets(matches: VerifiedMatches) -> VerifiedMatches:
    """Photos of a repeated facade have fewer matches than those of the same one."""
    keypoints = tuple(
        k[:40] if one < PHOTOS // 2 <= other else k
        for (one, other), k in zip(matches.pairs.tolist(), matches.keypoints, strict=True)
    )
    return VerifiedMatches(matches.photo_ids, matches.pairs, keypoints)


@pytest.mark.parametrize("noise_m", [0.0, 5.0], ids=["survey", "phone"])
def test_matches_of_two_streets_that_look_alike_are_dropped(
    scene: ReconstructedScene, matches: VerifiedMatches, noise_m: float
) -> None:
    positions = 3 * scene.component.centres()
    positions[PHOTOS // 2 :, 1] += STREET_M
    positions += np.random.default_rng(0).normal(0, noise_m, positions.shape)
    matches = weaker_between_streets(matches)
    kept = matches.only(agreeing_pairs(photos_at(scene, positions), matches))
    is_second = kept.pairs >= PHOTOS // 2
    assert (is_second[:, 0] == is_second[:, 1]).all()
    assert len(kept.pairs) == sum(1 for _ in combinations(range(PHOTOS // 2), 2)) * 2


def test_photos_in_no_component_are_explained_by_their_matches(
    scene: ReconstructedScene, matches: VerifiedMatches
) -> None:
    positions = 3 * scene.component.centres()
    without_first = weaker_between_streets(matches).only(matches.pairs[:, 0] > 0)
    for apart_m, expected in ((0.0, UNCONNECTED), (STREET_M, CONTRADICTED)):
        positions[PHOTOS // 2 :, 1] += apart_m
        reasons = explain_left_out(photos_at(scene, positions), without_first)
        assert list(reasons.values()) == [NO_MATCHES, *[expected] * (PHOTOS - 1)]


def test_photo_with_wrong_coordinates_keeps_its_matches(
    scene: ReconstructedScene, matches: VerifiedMatches
) -> None:
    positions = 3 * scene.component.centres()
    positions[4, 1] += STREET_M
    assert agreeing_pairs(photos_at(scene, positions), matches).all()


class FoldedWalk:
    """A walk around a corner, in whose model the photos after it are on the first street."""

    def __init__(self, noise_m: float) -> None:
        first = np.column_stack([np.arange(0, 100, 2.5), np.zeros(40), np.full(40, 1.6)])
        second = np.column_stack([np.full(12, 100.0), np.arange(40, 70, 2.5), np.full(12, 1.6)])
        self.places = np.concatenate([first, second])
        self.modelled = self.places.copy()
        self.modelled[40:] = first[5:17]
        self.centres = self.modelled @ TURN / 3
        ahead = np.repeat([[0.5, 1.0, 0.1], [1.0, 0.5, 0.1]], (40, 12), axis=0)
        self.rotations = [
            looking(place, place + way) @ TURN
            for place, way in zip(self.places, ahead, strict=True)
        ]
        self.seen = self.places + np.random.default_rng(1).normal(0, noise_m, self.places.shape)
        self.pairs = np.array(
            [(i, j) for j in range(52) for i in range(max(0, j - 4), j)]
            + [(i - 35, i) for i in range(40, 52)],
            np.int32,
        )
        self.counts = np.where(np.diff(self.pairs)[:, 0] > 4, 40, 200)

    def misplaced(self) -> tuple[set[int], np.ndarray]:
        """Return the misplaced photos, and the pairs that led there."""
        photos, pairs = find_misplaced(
            self.centres, self.rotations, self.seen, self.pairs, self.counts, np.zeros(52, int)
        )
        return set(np.flatnonzero(photos).tolist()), self.pairs[pairs]


@pytest.mark.parametrize("noise_m", [0.0, 5.0], ids=["survey", "phone"])
def test_photos_on_the_wrong_street_are_found_with_the_matches_that_led_there(
    noise_m: float,
) -> None:
    misplaced, pairs = FoldedWalk(noise_m).misplaced()
    assert set(range(43, 52)) <= misplaced <= set(range(38, 52))
    assert len(pairs) >= 9
    assert (np.diff(pairs) == 35).all()


def test_single_photo_on_the_wrong_street_is_found() -> None:
    walk = FoldedWalk(1.0)
    walk.centres = walk.places @ TURN / 3
    walk.centres[51] = walk.places[16] @ TURN / 3
    misplaced, pairs = walk.misplaced()
    assert (misplaced, pairs.tolist()) == ({51}, [[16, 51]])


def test_wrong_coordinates_of_single_photos_are_no_wrong_places() -> None:
    walk = FoldedWalk(1.0)
    walk.centres = walk.places @ TURN / 3
    walk.seen[[5, 20, 33], 1] += 80
    misplaced, pairs = walk.misplaced()
    assert (misplaced, len(pairs)) == (set(), 0)
