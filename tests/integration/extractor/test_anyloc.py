"""Maps on DINOv2: their photos wait for the operator's weights, then for a vocabulary."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from shared.catalog.jobs import WaitingFor
from shared.config.settings import Settings
from shared.jobs import JobState
from tests.integration.workplace import Workplace
from tests.support.catalog_rows import problem_of, set_columns
from tests.support.photos import photo_bytes
from tests.support.vit import random_weights, save

# Of the smallest network its first values: a thousandth of the work, on the same code.
EXTRACTOR = "anyloc-vits14:clusters=2,layer=0"


@pytest.fixture
def weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where DINO_WEIGHTS points; nothing lies there yet."""
    path = tmp_path / "dinov2_vits14_pretrain.pth"
    monkeypatch.setenv("DINO_WEIGHTS", str(path))
    return path


@pytest.fixture
def settings(weights: Path) -> Settings:
    found = Settings()
    assert found.dino_weights == weights
    return found


def test_photos_wait_for_weights_then_for_a_vocabulary_and_a_fit_makes_them_searchable(
    workplace_of: Callable[[str], Workplace], weights: Path
) -> None:
    from shared.descriptors.backbones.dinov2 import SHAPES

    workplace = workplace_of(EXTRACTOR)
    (photo,) = workplace.upload(1)
    workplace.drain()
    job = workplace.job_of(photo)
    assert job.state == JobState.QUEUED
    assert problem_of(job)["code"] == "weights_missing"
    assert str(weights) in problem_of(job)["detail"]
    assert "Three ways" in problem_of(job)["detail"]

    save(random_weights(SHAPES["vits14"], blocks=1), weights)
    set_columns(workplace.catalog, job.id, run_after=None)
    workplace.drain()
    job = workplace.job_of(photo)
    assert (job.state, job.waiting_for) == (JobState.QUEUED, WaitingFor.VOCABULARY)

    workplace.upload(2)
    fit = workplace.fit(clusters=None)
    assert fit.state == JobState.SUCCEEDED, fit.error
    generation = workplace.active()
    assert generation.extractor == EXTRACTOR
    assert generation.dimension == 2 * 384
    spec = generation.spec
    assert (spec["backbone"], spec["layer"], spec["facet"]) == ("dinov2-vits14", "0", "value")
    assert workplace.searchable() == 2
    query = workplace.ask(photo_bytes(1))
    workplace.drain()
    assert workplace.job(query).state == JobState.SUCCEEDED
