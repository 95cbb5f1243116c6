"""The fit of what photos of elsewhere score, on features that are drawn at random."""

from __future__ import annotations

import numpy as np
import pytest

from lab.benchmarks.place_prior import OWN, PASSING, QUERIES, fit_elsewhere, fit_levels
from shared.evaluation.places.fit import PlaceSample
from shared.evaluation.places.levels import FEATURES, CandidateLevel
from shared.evaluation.places.probability import shipped_prior

pytestmark = pytest.mark.numerics


@pytest.mark.parametrize("features", [2, 3])
def test_one_in_twenty_of_each_set_passes_and_what_misleads_has_no_weight(features: int) -> None:
    """The second feature is larger for photos of elsewhere; one set is harder than the others."""
    rng, size = np.random.default_rng(0), (60, features)
    means = {QUERIES: (8, 0, 4), "easy": (1, 2, 1), "hard": (3, 2, 1), "other": (1, 2, 1)}
    maps = [{k: rng.normal(m[:features], 1, size) for k, m in means.items()} for _ in range(3)]
    intercept, *slopes = fit_elsewhere([(str(n), each) for n, each in enumerate(maps)])
    assert slopes[0] < 0 == slopes[1]
    passing = {
        name: [np.mean(intercept + each[name] @ np.array(slopes) <= PASSING) for each in maps]
        for name in means
    }
    assert max(*passing["easy"], *passing["hard"]) <= 0.05
    assert min(passing[QUERIES]) > 0.9


def test_levels_learn_as_much_from_a_few_queries_as_from_many_own_photos() -> None:
    """Own photos with the same features are right, the queries wrong: neither outvotes."""
    levels = [CandidateLevel(radius_m=25.0, features=np.zeros(len(FEATURES)))]
    own = [PlaceSample(number, levels, [True]) for number in range(90)]
    asked = [PlaceSample(number, levels, [False]) for number in range(10)]
    intercept, *slopes = fit_levels([{OWN: own, QUERIES: asked}])
    design = shipped_prior().design(levels[0].features[None])[0]
    assert design @ np.array([intercept, *slopes]) == pytest.approx(0.0, abs=1e-3)
