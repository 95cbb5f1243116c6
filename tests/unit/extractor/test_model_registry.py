"""Loaded models: one copy of the weights, whatever names the maps know them by."""

from __future__ import annotations

from pathlib import Path

import pytest

from services.extractor.model_registry import MAX_EXTRACTORS, ModelRegistry
from shared.config.settings import Settings
from shared.errors import Misconfigured
from shared.storage import FolderStore
from tests.support.checkpoints import none_added
from tests.support.hub import write_hub


@pytest.fixture
def models(store: FolderStore, settings: Settings) -> ModelRegistry:
    return ModelRegistry(store, settings.model_copy(update={"device": "cpu"}), none_added)


def test_an_extractor_is_loaded_once_under_all_its_spellings(models: ModelRegistry) -> None:
    loaded = models.extractor("test-tiny-vlad")
    assert models.extractor("test-tiny-vlad:clusters=8") is loaded
    assert models.extractor("test-tiny-vlad:clusters=08") is loaded


def test_extractors_that_differ_in_what_follows_the_backbone_share_it(
    models: ModelRegistry,
) -> None:
    vlad, average = models.extractor("test-tiny-vlad:clusters=3"), models.extractor("test-tiny-avg")
    assert average.backbone is vlad.backbone
    assert (vlad.config.clusters, average.config.aggregator) == (3, "avg")


def test_the_least_recently_used_extractors_are_unloaded(models: ModelRegistry) -> None:
    first = models.extractor("test-tiny-vlad:clusters=1")
    for clusters in range(2, MAX_EXTRACTORS + 2):
        models.extractor(f"test-tiny-vlad:clusters={clusters}")
    assert models.extractor("test-tiny-vlad:clusters=1") is not first


def test_torchscript_whose_hash_is_no_longer_allowed_is_not_executed(
    store: FolderStore, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    name = f"torchhub:{write_hub(tmp_path / 'hub')}:colours"
    monkeypatch.setenv("CODE_ALLOWED", name)
    assert ModelRegistry(store, Settings(), none_added).extractor(name).dimension(None) == 24
    monkeypatch.setenv("CODE_ALLOWED", f"{name}:dimension=8")
    with pytest.raises(Misconfigured) as caught:
        ModelRegistry(store, Settings(), none_added).extractor(name)
    assert caught.value.code == "code_not_allowed"
    assert name in caught.value.detail


def test_networks_of_one_folder_share_nothing_unless_all_of_the_name_agrees(
    store: FolderStore, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    name = f"torchhub:{write_hub(tmp_path / 'hub')}:colours"
    monkeypatch.setenv("CODE_ALLOWED", f"{name} {name}:dimension=8")
    models = ModelRegistry(store, Settings(), none_added)
    assert models.extractor(f"{name}:dimension=8").dimension(None) == 8
    assert models.extractor(name).dimension(None) == 24
    assert models.extractor(name) is models.extractor(name)
