"""A map on DINOv2; tests/integration/gateway/test_health.py waits for its weights."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from shared.catalog.jobs import WaitingFor
from shared.config.settings import Settings
from shared.jobs import JobState
from tests.integration.harness import Harness
from tests.support.photos import photo_bytes
from tests.support.vit import random_weights, save

# Of the smallest network its first values: a thousandth of the work, on the same code.
EXTRACTOR = "anyloc-vits14:clusters=2,layer=0"


@pytest.fixture
def settings(weights: Path) -> Settings:
    found = Settings()
    assert found.dino_weights == weights
    return found


def test_a_fit_makes_the_photos_of_a_dinov2_map_searchable(
    harness_of: Callable[[str], Harness], weights: Path
) -> None:
    from shared.descriptors.backbones.dinov2 import SHAPES

    save(random_weights(SHAPES["vits14"], blocks=1), weights)
    harness = harness_of(EXTRACTOR)
    (photo, _) = harness.upload(1, 2)
    harness.drain()
    job = harness.job_of(photo)
    assert (job.state, job.waiting_for) == (JobState.QUEUED, WaitingFor.VOCABULARY)
    fit = harness.fit(clusters=None)
    assert fit.state == JobState.SUCCEEDED, fit.error
    generation = harness.active()
    assert generation.extractor == EXTRACTOR
    assert generation.dimension == 2 * 384
    spec = generation.spec
    assert (spec["backbone"], spec["layer"], spec["facet"]) == ("dinov2-vits14", "0", "value")
    assert harness.searchable() == 2
    query = harness.ask(photo_bytes(1))
    harness.drain()
    assert harness.job(query).state == JobState.SUCCEEDED
