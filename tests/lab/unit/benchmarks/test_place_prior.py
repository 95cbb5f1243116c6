"""The fit of what photos of elsewhere score, on features that are drawn at random."""

from __future__ import annotations

import numpy as np
import pytest

from lab.benchmarks.place_prior import OWN, PASSING, QUERIES, fit_log_odds

pytestmark = pytest.mark.numerics


def test_one_in_twenty_photos_of_each_set_passes_and_a_feature_that_misleads_has_no_weight() -> (
    None
):
    """The second feature is larger for photos of elsewhere; one set is harder than the other."""
    rng = np.random.default_rng(0)
    means = {OWN: (8, 0), QUERIES: (6, 0), "easy": (1, 2), "hard": (3, 2)}
    maps = [{name: rng.normal(mean, 1, (60, 2)) for name, mean in means.items()} for _ in range(3)]
    intercept, *slopes = fit_log_odds(maps)
    assert slopes[0] < 0 == slopes[1]
    passing = {
        name: [np.mean(intercept + each[name] @ np.array(slopes) <= PASSING) for each in maps]
        for name in means
    }
    assert max(*passing["easy"], *passing["hard"]) <= 0.05
    assert min(passing[OWN]) > 0.9
