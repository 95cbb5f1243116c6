"""Checkpoints of place models: what they hold comes back, and nothing in them is executed."""

from __future__ import annotations

import copy
import io
import zipfile
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
import torch

from services.extractor.added_models import training_card
from shared.descriptors.vpr_models.checkpoint import (
    Checkpoint,
    checkpoint_state,
    load_checkpoint,
    model_fingerprint,
)
from shared.descriptors.vpr_models.config import VprModelConfig
from shared.descriptors.vpr_models.model import VprModel, build_vpr_model
from shared.errors import NotFound, Unprocessable
from tests.support.memory import memory_bytes, reset_peak_memory

SWOLLEN_BYTES = 256 << 20
ZEROS = bytes(4 << 20)


def some_model(seed: int = 0, **changes: Any) -> VprModel:
    torch.manual_seed(seed)
    values = {"pretrained": False, "agg_arch": "GeM", "layers_to_crop": [3], "image_size": (32, 48)}
    return build_vpr_model(VprModelConfig.parse(values | changes))


@pytest.fixture(scope="module")
def model() -> VprModel:
    return some_model()


def saved(path: Path, state: Any) -> Path:
    torch.save(state, path)
    return path


def refusal(path: Path) -> Unprocessable:
    with pytest.raises(Unprocessable) as refused:
        load_checkpoint(path)
    return refused.value


def test_a_checkpoint_brings_back_the_model_and_where_it_comes_from(
    model: VprModel, tmp_path: Path
) -> None:
    file = saved(tmp_path / "model.ckpt", checkpoint_state(model, lr=0.1, cities=["Oslo"]))
    found = load_checkpoint(file)
    photos = torch.randn(2, 3, 32, 48)
    with torch.inference_mode():
        assert torch.equal(found.model(photos), model(photos))
    assert found.config == model.config
    assert found.fingerprint == model_fingerprint(model)
    assert found.about == {"lr": 0.1, "cities": ["Oslo"]}
    assert not found.model.training
    assert not any(parameter.requires_grad for parameter in found.model.parameters())


def test_lightning_state_beside_the_weights_is_ignored(model: VprModel, tmp_path: Path) -> None:
    state = checkpoint_state(model) | {
        "epoch": 7,
        "global_step": 4382,
        "pytorch-lightning_version": "2.6.0",
        "optimizer_states": [{"state": {0: {"exp_avg": torch.zeros(3)}}}],
        "lr_schedulers": [{"milestones": Counter({5: 1, 10: 1})}],
        "callbacks": {"ModelCheckpoint": {"best_model_score": torch.tensor(0.5)}},
    }
    state["state_dict"]["loss.weight"] = torch.zeros(2)
    found = load_checkpoint(saved(tmp_path / "last.ckpt", state))
    assert found.about == {"epoch": 7, "global_step": 4382}
    assert found.fingerprint == model_fingerprint(model)


def test_the_fingerprint_follows_what_decides_a_descriptor(model: VprModel) -> None:
    first = model_fingerprint(model)
    assert model_fingerprint(some_model(layers_to_freeze=-1)) == first
    assert model_fingerprint(some_model(seed=1)) != first
    assert model_fingerprint(some_model(image_size=(64, 96))) != first
    assert model_fingerprint(some_model(agg_config={"eps": 1e-5})) != first


class Bomb:
    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.target,)


def test_a_checkpoint_that_would_execute_something_is_refused(
    model: VprModel, tmp_path: Path
) -> None:
    target = tmp_path / "executed"
    file = saved(tmp_path / "bomb.ckpt", checkpoint_state(model) | {"callbacks": Bomb(target)})
    error = refusal(file)
    assert error.code == "checkpoint_unreadable"
    assert "Unsupported global: GLOBAL getattr" in error.detail  # the way to Path.touch
    assert "weights_only" not in error.detail, "no unsafe advice"
    assert not target.exists()
    torch.load(file, weights_only=False)  # the test's own test: the bomb is one
    assert target.exists()


def test_files_that_are_no_checkpoint_are_refused_and_missing_ones_are_not_found(
    tmp_path: Path,
) -> None:
    file = tmp_path / "damaged.ckpt"
    for damage in (b"", b"not a checkpoint", b"PK\x03\x04 torn"):
        file.write_bytes(damage)
        assert refusal(file).code == "checkpoint_unreadable"
    with pytest.raises(NotFound) as refused:
        load_checkpoint(tmp_path / "none.ckpt")
    assert refused.value.code == "checkpoint_not_found"


def test_tensors_of_another_network_are_refused_by_name(model: VprModel, tmp_path: Path) -> None:
    stem = "model.backbone.stem.0.weight"
    state = checkpoint_state(model)
    tensors = state["state_dict"]
    faults: dict[str, dict[str, Any]] = {
        "it has no tensor backbone.stem.0.weight": {n: t for n, t in tensors.items() if n != stem},
        "extra is not in the network": tensors | {"model.extra": torch.zeros(1)},
        "expected (64, 3, 7, 7)": tensors | {stem: torch.zeros(64, 1, 7, 7)},
        "is not a dense tensor": tensors | {stem: "a word"},
    }
    for reported, changed in faults.items():
        error = refusal(saved(tmp_path / "other.ckpt", state | {"state_dict": changed}))
        assert error.code == "checkpoint_unusable"
        assert reported in error.detail


@pytest.mark.parametrize(
    "state", [[1, 2], {}, {"state_dict": {}}, {"state_dict": {}, "hyper_parameters": {"lr": 1}}]
)
def test_a_file_that_does_not_say_which_network_it_holds_is_refused(
    state: Any, tmp_path: Path
) -> None:
    assert refusal(saved(tmp_path / "weights.ckpt", state)).code == "checkpoint_unusable"


def test_a_checkpoint_can_not_ask_for_more_memory_than_it_has_bytes(
    model: VprModel, tmp_path: Path
) -> None:
    """A head of 2^20 x 2^20 numbers is laid out and refused; in memory it would be 4 TB."""
    state = checkpoint_state(model)
    claimed = {"agg_arch": "ConvAP", "agg_config": {"out_channels": 1 << 20, "s1": 1 << 20}}
    state["hyper_parameters"]["model"] |= claimed
    assert refusal(saved(tmp_path / "large.ckpt", state)).code == "checkpoint_unusable"


def deflated(data: bytes, path: Path, swollen: str) -> Path:
    """The archive with the entry of that name replaced by 256 MB of zeros, compressed."""
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(path, "w") as new:
        for info in old.infolist():
            if not info.filename.endswith(swollen):
                new.writestr(info.filename, old.read(info))
                continue
            info.compress_type = zipfile.ZIP_DEFLATED
            with new.open(info, "w", force_zip64=True) as entry:
                for _ in range(SWOLLEN_BYTES // len(ZEROS)):
                    entry.write(ZEROS)
    return path


def overlapping(data: bytes, path: Path) -> Path:
    """The archive with each storage listed a hundred times."""
    path.write_bytes(data)
    with zipfile.ZipFile(path, "a") as archive:
        for info in list(archive.infolist()):
            for number in range(100 if "/data/" in info.filename else 0):
                again = copy.copy(info)
                again.filename = f"{info.filename}-{number}"
                archive.filelist.append(again)
        archive._didModify = True  # type: ignore[attr-defined]
    return path


def repeated_views(path: Path) -> Path:
    """Tensors with the shapes of a large network, each of one number."""
    head = {"agg_arch": "ConvAP", "agg_config": {"out_channels": 1 << 14, "s1": 2, "s2": 2}}
    values: dict[str, Any] = {"pretrained": False, "image_size": (32, 48), **head}
    with torch.device("meta"):
        large = build_vpr_model(VprModelConfig.parse(values))
    state = checkpoint_state(large)
    for name, tensor in state["state_dict"].items():
        state["state_dict"][name] = torch.ones((), dtype=tensor.dtype).expand(tensor.shape)
    return saved(path, state)


@pytest.mark.parametrize("kind", ["storage", "pickle", "overlapping", "repeated views"])
def test_a_checkpoint_that_expands_in_memory_is_refused_before_it_is_read(
    model: VprModel, tmp_path: Path, kind: str
) -> None:
    buffer = io.BytesIO()
    torch.save(checkpoint_state(model), buffer)
    data, path = buffer.getvalue(), tmp_path / "hostile.ckpt"
    if kind == "repeated views":
        file, why = repeated_views(path), "bytes by their shapes"
    elif kind == "overlapping":
        file, why = overlapping(data, path), "compressed or overlap"
    else:
        swollen = "data/0" if kind == "storage" else "data.pkl"
        file, why = deflated(data, path, swollen), "compressed or overlap"
    assert file.stat().st_size < len(data) + 1_000_000
    reset_peak_memory()
    before = memory_bytes("VmHWM")
    assert why in refusal(file).detail
    assert memory_bytes("VmHWM") - before < SWOLLEN_BYTES / 4


def test_a_long_value_that_is_named_many_times_is_not_copied_as_often(model: VprModel) -> None:
    rows = ["x" * 10_000] * 100_000
    hostile = Checkpoint(model, model.config, "0", {"epoch": 3, "rows": [rows] * 100_000})
    assert training_card(hostile) == {
        "epoch": 3,
        "left_out": "the hyperparameters, which are too long",
    }
    plain = Checkpoint(model, model.config, "0", {"lr": 0.1, "steps": 1 << 100, "cities": ["Oslo"]})
    assert training_card(plain) == {"lr": 0.1, "steps": "<int>", "cities": ["Oslo"]}
