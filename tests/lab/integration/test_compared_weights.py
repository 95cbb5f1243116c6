"""The weights of two extractors side by side are chosen on a map's own photos."""

from __future__ import annotations

import numpy as np
import pytest
from rich.progress import Progress

from lab.cli.evaluation.compare_on_map import Described, MapComparison
from tests.integration.in_process_api import Service

pytestmark = pytest.mark.databases("sqlite")

PLACES = 6


def test_the_weights_that_find_most_of_the_maps_own_photos_are_chosen(service: Service) -> None:
    for number in range(2 * PLACES):
        service.indexed(number, place=f"place {number // 2}")
    settings = service.settings.model_copy(update={"device": "cpu"})
    comparison = MapComparison(
        service.catalog, service.store, settings, "default", 100, Progress(disable=True)
    )
    spots = [photo.spot.place for photo in comparison.evaluation.database.photos]
    same = np.array([[a == b for b in spots] for a in spots])
    # The second misleads twice as much as the first helps: it may weigh less than a third.
    right = np.where(same, 0.6, 0.5).astype(np.float32)
    misleading = np.where(same, 0.4, 0.6).astype(np.float32)
    comparison.described["patchnorm"] = Described(right, 0.25, 10)
    comparison.described["test-tiny-avg"] = Described(misleading, 0.5, 20)
    compared = comparison.compare("patchnorm+test-tiny-avg", choose_weights=True)
    assert compared["extractor"] == "patchnorm@0.7+test-tiny-avg@0.3"
    assert compared["recall_at_1"]["mean"] == 1
    assert compared["cpu_seconds"] == 0.75
    assert compared["bytes"] == 30 * 4
    equal = comparison.compare("patchnorm+test-tiny-avg", choose_weights=False)
    assert equal["recall_at_1"]["mean"] == 0
