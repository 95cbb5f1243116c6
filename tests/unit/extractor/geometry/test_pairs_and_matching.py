"""Which photos are matched with which, and their stored matches."""

from __future__ import annotations

from uuid import UUID

import numpy as np
import pytest

from services.extractor.geometry import pairs
from services.extractor.geometry.matching import VerifiedMatches, match_pairs
from services.extractor.geometry.pairs import choose_pairs
from tests.support.reconstructed_scene import ReconstructedScene

COUNT = 60
NOWHERE = np.full(COUNT, np.nan)


def chosen(
    descriptors: np.ndarray, seconds: np.ndarray, latitudes: np.ndarray, longitudes: np.ndarray
) -> set[tuple[int, int]]:
    found = choose_pairs(descriptors, seconds, latitudes, longitudes)
    assert (found[:, 0] < found[:, 1]).all()
    assert len(np.unique(found, axis=0)) == len(found)
    return {(int(one), int(other)) for one, other in found}


def unrelated() -> np.ndarray:
    return np.random.default_rng(0).normal(size=(COUNT, 8)).astype(np.float32)


def test_photos_that_look_alike_are_pairs() -> None:
    rows = unrelated()
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    rows[50] = rows[3]
    found = chosen(rows, NOWHERE, NOWHERE, NOWHERE)
    assert (3, 50) in found
    assert len(found) <= COUNT * pairs.NEAREST


def test_neighbours_in_time_and_place_are_pairs() -> None:
    seconds = np.arange(COUNT)[::-1] * 2.0
    seconds[:10] += 1000  # after a pause
    seconds[30] = np.nan
    found = chosen(np.zeros((COUNT, 8), np.float32), seconds, NOWHERE, NOWHERE)
    nearest = {(0, other) for other in range(1, COUNT)}  # no descriptor is nearer than another
    in_time = {pair for pair in found if pair[0] > pairs.NEAREST + 1} - nearest
    assert {(20, 21), (20, 20 + pairs.NEXT_IN_TIME), (29, 31)} <= in_time
    assert (20, 21 + pairs.NEXT_IN_TIME) not in in_time
    assert not any(30 in pair for pair in in_time)

    longitudes = np.where(np.arange(COUNT) % 2, 179.99995, -179.99995)
    latitudes = np.arange(COUNT) * 1e-4  # 11 m
    found = chosen(np.zeros((COUNT, 8), np.float32), NOWHERE, latitudes, longitudes)
    assert {(40, 41), (40, 42)} <= found  # across the antimeridian
    assert (40, 43) not in found  # farther than MAX_DISTANCE_M


def test_photos_of_two_floors_are_no_pair_unless_both_have_coordinates() -> None:
    seconds = np.linspace(0, 2.0 * COUNT, COUNT)
    rows = np.zeros((COUNT, 8), np.float32)
    floors = [("tower/1", "tower/2", None)[number % 3] for number in range(COUNT)]

    def across(latitudes: np.ndarray, longitudes: np.ndarray) -> set[tuple[str, str]]:
        found = choose_pairs(rows, seconds, latitudes, longitudes, floors).tolist()
        assert any(floors[one] is None != floors[other] for one, other in found)
        named = [{floors[one], floors[other]} - {None} for one, other in found]
        return {tuple(sorted(names)) for names in named if len(names) == 2}

    assert not across(NOWHERE, NOWHERE)
    assert across(np.full(COUNT, 45.0), np.full(COUNT, 7.0))


def test_map_without_photos_has_no_pairs() -> None:
    empty = np.empty(0)
    assert choose_pairs(np.empty((0, 8), np.float32), empty, empty, empty).shape == (0, 2)


@pytest.fixture(scope="module")
def matches() -> VerifiedMatches:
    scene, other = ReconstructedScene(photos=3), ReconstructedScene(photos=1, seed=1)
    reports: list[int] = []
    found = match_pairs(
        {**scene.features, **other.features},
        np.array([[0, 1], [0, 2], [0, 3]], np.int32),
        reports.append,
    )
    assert reports == [3]
    return found


def test_photos_of_one_scene_have_verified_matches(matches: VerifiedMatches) -> None:
    assert matches.pairs.tolist() == [[0, 1], [0, 2]]
    scene = ReconstructedScene(photos=3)
    for (one, other), keypoints in zip(matches.pairs, matches.keypoints, strict=True):
        assert len(keypoints) > 100
        numbers = scene.component.point_numbers
        first, second = numbers[one][keypoints[:, 0]], numbers[other][keypoints[:, 1]]
        assert np.mean(first == second) > 0.98


def test_matches_are_read_as_they_were_stored(matches: VerifiedMatches) -> None:
    read = VerifiedMatches.decode(matches.encode())
    assert read.photo_ids == matches.photo_ids
    np.testing.assert_array_equal(read.pairs, matches.pairs)
    for one, other in zip(read.keypoints, matches.keypoints, strict=True):
        np.testing.assert_array_equal(one, other)
    none = VerifiedMatches((UUID(int=1),), np.empty((0, 2), np.int32), ())
    assert VerifiedMatches.decode(none.encode()).keypoints == ()


def test_damaged_matches_are_a_value_error(matches: VerifiedMatches) -> None:
    with pytest.raises(ValueError, match="no verified matches"):
        VerifiedMatches.decode(matches.encode()[:-200])
    wrong = VerifiedMatches(matches.photo_ids[:1], matches.pairs, matches.keypoints)
    with pytest.raises(ValueError, match="not there"):
        VerifiedMatches.decode(wrong.encode())
    short = VerifiedMatches(matches.photo_ids, np.zeros((3, 2), np.int32), matches.keypoints)
    with pytest.raises(ValueError, match="matches of 3 pairs"):
        VerifiedMatches.decode(short.encode())
