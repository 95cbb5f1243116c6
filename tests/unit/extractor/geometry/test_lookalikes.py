"""Streets whose facades repeat: two places are not taken for one."""

from __future__ import annotations

from pathlib import Path
from uuid import UUID

import numpy as np
import pytest

from services.extractor.geometry.mapping import map_photos
from services.extractor.geometry.matching import match_pairs
from services.extractor.geometry.pycolmap_models import PhotoToMap
from shared.geometry.component import Component
from shared.geometry.frames import rotation_of_vector
from shared.matching.features import LocalFeatures
from tests.support.reconstructed_scene import CAMERA, DIMENSION, looking

FIRST, SECOND, STEP_M = 16, 10, 2.5
SIZE = (CAMERA.width, CAMERA.height)


class AlikeStreets:
    """A walk along two streets; three in ten points of the second one are copies of the first's."""

    def __init__(self, seed: int) -> None:
        self.rng = rng = np.random.default_rng(seed)
        points = [self._facade(count) for count in (FIRST, SECOND)]
        descriptors = [rng.normal(size=(len(each), DIMENSION)) for each in points]
        copied = np.flatnonzero(rng.random(len(points[1])) < 0.3)
        originals = rng.choice(len(points[1]), len(copied), replace=False)
        points[1][copied] = points[0][originals]
        descriptors[1][copied] = descriptors[0][originals]
        self.features: dict[UUID, LocalFeatures] = {}
        self.positions: list[np.ndarray] = []
        for street, count in enumerate((FIRST, SECOND)):
            turn = rotation_of_vector(np.array([0, 0, -street * np.pi / 2]))
            for number in range(count):
                centre = np.array([number * STEP_M, rng.normal(0, 0.2), 1.7])
                self.positions.append(turn @ centre + street * np.array([60.0, -20.0, 0.0]))
                id_ = UUID(int=len(self.positions))
                self.features[id_] = self._take(centre, points[street], descriptors[street])

    def _facade(self, photos: int) -> np.ndarray:
        """Points along the way, those before the second street's end first."""
        lengths = np.sort(self.rng.uniform(-6, photos * STEP_M + 10, round(20 * photos * STEP_M)))
        count = len(lengths)
        depths = 8 + self.rng.choice([0.0, 0.6, -1.5], count)
        return np.column_stack([lengths, depths, self.rng.uniform(-1, 7, count)])

    def _take(
        self, centre: np.ndarray, points: np.ndarray, descriptors: np.ndarray
    ) -> LocalFeatures:
        ahead = np.array([0.5 + self.rng.normal(0, 0.03), 1.0, 0.05])
        seen = (points - centre) @ looking(centre, centre + ahead).T
        found = np.flatnonzero((seen[:, 2] > 1) & (self.rng.random(len(seen)) < 0.75))
        pixels = CAMERA.project(seen[found]) + self.rng.normal(0, 0.5, (len(found), 2))
        inside = ((pixels > 0) & (pixels < SIZE)).all(axis=1)
        shown = descriptors[found[inside]] + self.rng.normal(0, 0.05, (inside.sum(), DIMENSION))
        shown /= np.linalg.norm(shown, axis=1, keepdims=True)
        places = (pixels[inside] - 0.5).astype(np.float32)
        return LocalFeatures.quantise(SIZE, SIZE, places, shown.astype(np.float32))

    def reconstruct(self, folder: Path, positions: np.ndarray | None) -> list[Component]:
        photos = [
            PhotoToMap(
                id_,
                *SIZE,
                each.pixels().astype(np.float32),
                position=None if positions is None else positions[row],
            )
            for row, (id_, each) in enumerate(self.features.items())
        ]
        pairs = np.array([(i, j) for j in range(len(photos)) for i in range(j)], np.int32)
        matches = match_pairs(self.features, pairs, lambda _: None)
        found = map_photos(photos, matches, folder, lambda _: None, lambda: None)
        return [each.component for each in found]


@pytest.mark.parametrize(("seed", "noise_m"), [(1, None), (5, 30.0)])
def test_streets_that_look_alike_are_components_of_their_own(
    tmp_path: Path, seed: int, noise_m: float | None
) -> None:
    streets = AlikeStreets(seed)
    noise = streets.rng.normal(0, noise_m or 0.0, (FIRST + SECOND, 3))
    positions = None if noise_m is None else np.array(streets.positions) + noise
    found = streets.reconstruct(tmp_path, positions)
    members = [{photo.int <= FIRST for photo in each.photo_ids} for each in found]
    assert all(len(each) == 1 for each in members)
    assert sum(len(each.photo_ids) for each in found) >= FIRST + SECOND - 3


def test_coordinates_decide_whether_alike_photos_show_one_place(tmp_path: Path) -> None:
    """The second walk is along the first street after most of it was repainted."""
    streets = AlikeStreets(0)
    positions = np.array(streets.positions[:FIRST] + streets.positions[:SECOND])
    (found,) = streets.reconstruct(tmp_path, positions)
    assert len(found.photo_ids) >= FIRST + SECOND - 2
