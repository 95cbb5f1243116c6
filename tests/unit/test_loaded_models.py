"""Loaded models: one copy of the weights, whatever names the maps know them by."""

from __future__ import annotations

import pytest

from services.extractor.loaded import MOST_EXTRACTORS, LoadedModels
from shared.objects import FolderStore
from shared.settings import Settings


@pytest.fixture
def models(store: FolderStore, settings: Settings) -> LoadedModels:
    return LoadedModels(store, settings.model_copy(update={"device": "cpu"}))


def test_an_extractor_is_loaded_once_under_all_its_spellings(models: LoadedModels) -> None:
    loaded = models.extractor("test-tiny-vlad")
    assert models.extractor("test-tiny-vlad:clusters=8") is loaded
    assert models.extractor("test-tiny-vlad:clusters=08") is loaded


def test_extractors_that_differ_in_what_follows_the_backbone_share_it(models: LoadedModels) -> None:
    vlad, average = models.extractor("test-tiny-vlad:clusters=3"), models.extractor("test-tiny-avg")
    assert average.backbone is vlad.backbone
    assert (vlad.recipe.clusters, average.recipe.aggregator) == (3, "avg")


def test_extractors_used_least_lately_are_let_go(models: LoadedModels) -> None:
    first = models.extractor("test-tiny-vlad:clusters=1")
    for clusters in range(2, MOST_EXTRACTORS + 2):
        models.extractor(f"test-tiny-vlad:clusters={clusters}")
    assert models.extractor("test-tiny-vlad:clusters=1") is not first
