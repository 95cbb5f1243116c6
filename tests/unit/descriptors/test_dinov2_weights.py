"""DINOv2's weights: one network under any publisher's names, and files that are refused."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save as safetensors_bytes

from shared.descriptors.backbones.dinov2 import Dinov2, VitShape
from shared.descriptors.extractor import Extractor
from shared.errors import Misconfigured
from shared.extractor_config.configs import get_extractor_config
from tests.support.vit import (
    PLAIN,
    SWIGLU,
    WITH_REGISTERS,
    Weights,
    chunked,
    random_weights,
    save,
    timms,
)

CPU = torch.device("cpu")
THREE_WAYS = (
    "(1) with internet access and DINO_WEIGHTS unset, timm's timm/vit_small_patch14_dinov2.lvd142m",
    "(2) download Meta's https://dl.fbaipublicfiles.com/dinov2/dinov2_vits14/dinov2_vits14_pretrain",
    "(3) copy model.safetensors",
)


def load(
    path: Path | None, shape: VitShape = PLAIN, layer: int = 2, facet: str = "value"
) -> Dinov2:
    return Dinov2("vits14", layer, facet, CPU, path, shape=shape)


def refusal(path: Path | None, code: str, shape: VitShape = PLAIN) -> str:
    """The detail with which the weights are refused; it always names the three ways."""
    with pytest.raises(Misconfigured) as caught:
        load(path, shape)
    assert caught.value.code == code
    for way in THREE_WAYS:
        assert way in caught.value.detail
    return caught.value.detail


def save_before_pytorch_1_6(weights: Weights, path: Path) -> Path:
    torch.save(weights, path, _use_new_zipfile_serialization=False)
    return path


# --- one network, several files --------------------------------------------------------------


@pytest.mark.parametrize("shape", [PLAIN, SWIGLU, WITH_REGISTERS])
def test_the_same_weights_are_the_same_network_in_every_naming_and_format(
    shape: VitShape, tmp_path: Path
) -> None:
    metas = random_weights(shape)
    files = [
        save(metas, tmp_path / "meta.pth"),
        save(chunked(metas), tmp_path / "chunked.pt"),
        save(metas, tmp_path / "meta.safetensors"),
        save(timms(metas), tmp_path / "timm.safetensors"),
        save(timms(metas), tmp_path / "timm.bin"),
        save_before_pytorch_1_6(metas, tmp_path / "old.pth"),
        save(timms(metas), tmp_path / "model.safetensors").rename(tmp_path / "3fa9c2"),
    ]
    pixels = torch.from_numpy(
        np.random.default_rng(1).integers(0, 256, (1, 56, 70, 3), dtype=np.uint8)
    )
    loaded = [load(file, shape, layer=1) for file in files]
    features = loaded[0].features(pixels)
    for file, backbone in zip(files, loaded, strict=True):
        assert torch.equal(backbone.features(pixels), features), file.name
        assert backbone.fingerprint == loaded[0].fingerprint, file.name
        assert backbone.card["file"] == file.name
        assert backbone.card["source"] == "DINO_WEIGHTS"
    files[0].write_bytes(b"\xff" * files[0].stat().st_size)
    assert torch.equal(loaded[0].features(pixels), features), "a file may go once it is loaded"


def test_fingerprint_is_that_of_the_tensors_in_use(tmp_path: Path) -> None:
    weights = random_weights(PLAIN)
    own = load(save(weights, tmp_path / "own.pth")).fingerprint

    def fingerprint_with(changed: str) -> str:
        nudged = {**weights, changed: weights[changed] + 1e-3}
        return load(save(nudged, tmp_path / "nudged.pth")).fingerprint

    for used in ("cls_token", "blocks.1.mlp.fc2.bias", "blocks.2.norm1.weight"):
        assert fingerprint_with(used) != own, used
    for unused in ("mask_token", "norm.weight", "blocks.2.norm2.bias", "blocks.3.norm1.weight"):
        assert fingerprint_with(unused) == own, unused


def test_half_precision_is_computed_in_single(tmp_path: Path) -> None:
    halves = {name: tensor.half() for name, tensor in random_weights(PLAIN).items()}
    widened = {name: tensor.float() for name, tensor in halves.items()}
    backbone = load(save(halves, tmp_path / "half.safetensors"))
    assert backbone.fingerprint == load(save(widened, tmp_path / "full.pth")).fingerprint
    assert backbone.features(torch.zeros((1, 28, 28, 3), dtype=torch.uint8)).dtype == torch.float32


# --- files that are refused ------------------------------------------------------------------


def test_a_missing_file_is_refused_with_three_ways_to_get_it(tmp_path: Path) -> None:
    reported = refusal(tmp_path / "gone.pth", "weights_missing")
    assert f"DINO_WEIGHTS={tmp_path / 'gone.pth'} does not exist" in reported
    assert "is not a file" in refusal(tmp_path, "weights_missing")


def plain(**changed: torch.Tensor | None) -> Weights:
    """Weights with some changed, or left out."""
    names = {name.replace("__", "."): tensor for name, tensor in changed.items()}
    return {n: t for n, t in {**random_weights(PLAIN), **names}.items() if t is not None}


@pytest.mark.parametrize(
    ("weights", "reason"),
    [
        (plain(blocks__1__ls2__gamma=None), "it has no tensor blocks.1.ls2.gamma (32,)"),
        (random_weights(PLAIN, blocks=1), "and 15 more"),
        (
            plain(pos_embed=torch.zeros(1, 257, 32)),
            "pos_embed is (1, 257, 32), expected (1, 1370, 32)",
        ),
        ({"cls_token": torch.zeros(1, 1, 768)}, "look like the weights of dinov2-vitb14"),
        (
            plain(blocks__0__norm1__bias=torch.full((32,), float("nan"))),
            "blocks.0.norm1.bias holds numbers that are not finite floats",
        ),
        (plain(blocks__0__norm1__bias=torch.ones(32, dtype=torch.int32)), "not finite floats"),
    ],
    ids=["missing", "many missing", "shape", "size", "nan", "integers"],
)
def test_tensors_of_another_network_are_refused_by_name(
    weights: Weights, reason: str, tmp_path: Path
) -> None:
    file = save(weights, tmp_path / "w.pth")
    detail = refusal(file, "weights_unusable")
    assert f"{file} can't be used for dinov2-vits14" in detail
    assert reason in detail


def test_weights_with_registers_are_not_taken_for_those_without(tmp_path: Path) -> None:
    weights = random_weights(WITH_REGISTERS)
    for file in (save(weights, tmp_path / "w.pth"), save(timms(weights), tmp_path / "w.pt")):
        assert "4 register tokens, expected 0" in refusal(file, "weights_unusable")
    plain = save(random_weights(PLAIN), tmp_path / "plain.pth")
    assert "0 register tokens, expected 4" in refusal(plain, "weights_unusable", WITH_REGISTERS)


def saved(value: object) -> bytes:
    buffer = io.BytesIO()
    torch.save(value, buffer)
    return buffer.getvalue()


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"<html>404 Not Found</html>",
        b"\xff\xff\xff\xff\xff\xff\xff\x7f{",
        saved(plain())[:20_000],
        safetensors_bytes(plain())[:20_000],
        saved(VitShape),
        saved(torch.zeros(3)),
        saved({"model": {}}),
    ],
    ids=["empty", "text", "declared size", "half a zip", "half", "code", "tensor", "nested"],
)
def test_files_without_named_tensors_are_refused(content: bytes, tmp_path: Path) -> None:
    file = tmp_path / "w.pth"
    file.write_bytes(content)
    assert f"{file} can't be used" in refusal(file, "weights_unusable")


# --- timm's file on the hub ------------------------------------------------------------------


@pytest.fixture
def offline_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty Hugging Face cache, on a machine that may not ask the hub."""
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "hub"))
    return tmp_path / "hub"


@pytest.mark.usefixtures("offline_cache")
def test_weights_that_can_not_be_downloaded_are_an_error_and_never_random() -> None:
    reported = refusal(None, "weights_missing")
    assert "DINO_WEIGHTS is not set" in reported
    with pytest.raises(Misconfigured, match=r"timm/vit_giant_patch14_dinov2\.lvd142m"):
        Extractor(get_extractor_config("anyloc-vitg14", allow_test_extractors=False), CPU)


def test_timms_file_in_the_cache_is_taken_without_asking_the_hub(offline_cache: Path) -> None:
    repository = offline_cache / "models--timm--vit_small_patch14_dinov2.lvd142m"
    snapshot = repository / "snapshots" / "0123abc"
    snapshot.mkdir(parents=True)
    (repository / "refs").mkdir()
    (repository / "refs" / "main").write_text("0123abc")
    save(timms(random_weights(PLAIN)), snapshot / "model.safetensors")
    backbone = load(None)
    assert backbone.card["source"] == "timm/vit_small_patch14_dinov2.lvd142m"
    assert backbone.card["size_bytes"] > 0


def test_a_network_that_breaks_off_is_an_error_with_the_three_ways(
    monkeypatch: pytest.MonkeyPatch, offline_cache: Path
) -> None:
    import httpx2
    import huggingface_hub

    def breaks(*_arguments: object) -> str:
        raise httpx2.ReadError("the connection was reset")

    monkeypatch.setattr(huggingface_hub, "get_hf_file_metadata", breaks)
    assert "the connection was reset" in refusal(None, "weights_missing")
    assert not offline_cache.exists()
