"""The doctor's look at weights and memory: what works, and what to do about what does not."""

from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from services.cli.operations import installation_checks
from services.cli.operations.installation_checks import check_device, check_extractor, check_memory
from shared.config import settings as settings_module
from shared.config.settings import Settings, memory_limit_bytes
from shared.descriptors.backbones import dinov2
from shared.descriptors.backbones.dinov2 import SHAPES
from shared.errors import Misconfigured
from tests.support.hub import COMMIT, write_hub
from tests.support.vit import random_weights, save

GB = 1_000_000_000


def settings_with(monkeypatch: pytest.MonkeyPatch, **variables: str | Path) -> Settings:
    """Settings without the extractor of the tests."""
    monkeypatch.delenv("EXTRACTOR")
    for name, value in variables.items():
        monkeypatch.setenv(name, str(value))
    return Settings()


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """Weights of what `anyloc-vits14:layer=0` needs."""
    return save(random_weights(SHAPES["vits14"], blocks=1), tmp_path / "vits.pth")


def test_weights_that_fit_are_named_without_being_loaded(
    monkeypatch: pytest.MonkeyPatch, small: Path
) -> None:
    def load(*_arguments: object) -> None:
        raise AssertionError("the weights were loaded")

    monkeypatch.setattr(dinov2, "load_vit_weights", load)
    settings = settings_with(
        monkeypatch, DINO_MODEL="dinov2_vits14", DESC_LAYER="0", DINO_WEIGHTS=small
    )
    reported = check_extractor(settings)
    assert "anyloc-vits14:layer=0" in reported
    assert str(small) in reported
    assert "GB) match" in reported


def test_weights_without_the_chosen_layer_are_reported(
    monkeypatch: pytest.MonkeyPatch, small: Path
) -> None:
    settings = settings_with(monkeypatch, DINO_MODEL="dinov2_vits14", DINO_WEIGHTS=small)
    with pytest.raises(Misconfigured, match=r"it has no tensor blocks\.1\.norm1\.weight") as caught:
        check_extractor(settings)
    assert caught.value.code == "weights_unusable"


def test_missing_weights_are_reported_with_three_ways_to_get_them(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "hub"))
    settings = settings_with(monkeypatch, DINO_MODEL="dinov2_vitg14")
    with pytest.raises(Misconfigured) as caught:
        check_extractor(settings)
    assert caught.value.code == "weights_missing"
    ways = ("(1)", "(2)", "(3)", "dinov2_vitg14_pretrain.pth")
    for words in ("not in the Hugging Face cache", *ways):
        assert words in caught.value.detail


def test_other_extractors_are_loaded() -> None:
    assert "test-tiny-avg: weights" in check_extractor(Settings())


def test_an_entry_of_torch_hub_is_tried_and_never_downloaded(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.setattr("shared.descriptors.backbones.torchhub.GITHUB", "unreachable")
    missing = f"torchhub:somebody/places@{COMMIT}:colours"
    with pytest.raises(Misconfigured, match="its code is not downloaded") as caught:
        check_extractor(settings_with(monkeypatch, EXTRACTOR=missing))
    assert caught.value.code == "weights_missing"
    assert str(tmp_path) not in caught.value.detail
    monkeypatch.setenv("EXTRACTOR", f"torchhub:{write_hub(tmp_path / 'hub')}:colours")
    assert "load" in check_extractor(Settings())
    assert "is unknown until it is loaded" in check_memory(Settings())


def test_missing_cuda_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    settings = settings_with(monkeypatch, DEVICE="cuda")
    for check in (check_device, check_memory):
        with pytest.raises(Misconfigured, match="nvidia-smi"):
            check(settings)


def pretend_gpu(monkeypatch: pytest.MonkeyPatch, total: int) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(
        torch.cuda, "get_device_properties", lambda _device: SimpleNamespace(total_memory=total)
    )


def test_memory_that_is_enough_is_shown_with_the_estimate(monkeypatch: pytest.MonkeyPatch) -> None:
    pretend_gpu(monkeypatch, 16 * GB)
    reported = check_memory(settings_with(monkeypatch, DINO_MODEL="dinov2_vitg14", DEVICE="cuda"))
    assert "anyloc-vitg14 requires about 8.1 GB (weights 4.5, a batch of 64 photos 2.6)" in reported
    assert "the GPU has 16.0 GB" in reported


@pytest.mark.parametrize(
    ("gpu", "settings", "remedies"),
    [
        (4 * GB, {}, "a smaller DINO_MODEL (dinov2_vits14 takes 0.1 GB of weights), or DEVICE=cpu"),
        (6 * GB, {"BATCH_PHOTOS": "64"}, "BATCH_PHOTOS below 64"),
        # 21 times the pixels of 224 x 224, whatever the batch
        (
            6 * GB,
            {"BATCH_PHOTOS": "1", "EXTRACTOR": "anyloc-vitg14:preprocessing=demo1024"},
            "preprocessing square224",
        ),
    ],
)
def test_insufficient_gpu_memory_is_reported_with_a_remedy(
    monkeypatch: pytest.MonkeyPatch, gpu: int, settings: dict[str, str], remedies: str
) -> None:
    pretend_gpu(monkeypatch, gpu)
    chosen = {} if "EXTRACTOR" in settings else {"DINO_MODEL": "dinov2_vitg14"}
    with pytest.raises(Misconfigured) as caught:
        check_memory(settings_with(monkeypatch, DEVICE="cuda", **chosen, **settings))
    assert caught.value.code == "memory_short"
    assert remedies in caught.value.detail
    assert ("BATCH_PHOTOS" in caught.value.detail) == ("BATCH_PHOTOS" in remedies)


def test_insufficient_ram_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(installation_checks, "memory_limit_bytes", lambda: 2 * GB)
    settings = settings_with(monkeypatch, DINO_MODEL="dinov2_vitl14", DEVICE="cpu")
    with pytest.raises(Misconfigured) as caught:
        check_memory(settings)
    assert "this machine has 2.0 GB" in caught.value.detail
    assert "DEVICE=cpu" not in caught.value.detail


def test_ram_of_a_container_is_its_limit(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    limit = tmp_path / "memory.max"
    monkeypatch.setattr(settings_module, "CGROUP_MEMORY_LIMIT_FILE", limit)
    whole = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    assert memory_limit_bytes() == whole
    for written, expected in (("max\n", whole), ("1000000\n", 1_000_000), ("9" * 30, whole)):
        limit.write_text(written)
        assert memory_limit_bytes() == expected
