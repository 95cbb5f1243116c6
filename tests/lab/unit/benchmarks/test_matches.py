"""`placewise bench matches`: what it reports of a set whose photos match."""

from __future__ import annotations

import numpy as np

from lab.benchmarks.estimates import DescribedPhotos
from lab.benchmarks.matches import MatchedPhotos, add_cost, compare
from lab.benchmarks.report import Report
from shared.evaluation.places.evidence import PhotoLocation
from shared.evaluation.places.levels import LevelScheme
from shared.matching.features import LocalFeatures
from tests.support.local_features import scene_features

PLACES, PER_PLACE = 16, 4


def described() -> DescribedPhotos:
    """Places whose descriptors overlap."""
    rng = np.random.default_rng(0)
    rows = np.repeat(rng.normal(size=(PLACES, 16)), PER_PLACE, 0)
    rows += 0.9 * rng.normal(size=rows.shape)
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    numbers = np.arange(len(rows))
    return DescribedPhotos(
        "house",
        rows.astype(np.float32),
        [PhotoLocation(None, None, f"house/{n // PER_PLACE}") for n in numbers.tolist()],
        [None] * len(rows),
        numbers % PER_PLACE == 0,
        numbers // PER_PLACE,
        LevelScheme(labels_are_paths=True, radii_m=(25.0,)),
        25.0,
    )


def features() -> list[LocalFeatures]:
    """Photos of one place show the same points from other positions."""
    return [
        scene_features(number // PER_PLACE, view=0.1 * (number % PER_PLACE), points=40)
        for number in range(PLACES * PER_PLACE)
    ]


def test_matches_find_the_places_that_descriptors_confuse_at_a_cost_that_is_reported() -> None:
    matched = MatchedPhotos(features().__getitem__)
    report = Report("matches")
    compare(report, described(), matched)
    add_cost(report, "house", features(), matched, seconds=0.64)
    measured = {figure.what: figure.measured for figure in report.figures}
    recalls = [
        measured[f"house, {name} matches: right at the finest level"]
        for name in ("without", "with")
    ]
    assert recalls[1] > recalls[0] + 10
    assert measured["house: CPU a photo"] == 10
    assert measured["house: bytes a photo"] == 16 + 40 * 68
    assert 0 < measured["house: CPU a pair, matching alone"] < measured["house: CPU a pair"]
