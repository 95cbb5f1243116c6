"""The network of a run: where its weights come from."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from lab.training.arguments import build_arguments
from lab.training.model_factory import build_model_config, make_model
from lab.training.run_control import NullDisplay
from shared.descriptors.vpr_models.checkpoint import checkpoint_state
from shared.descriptors.vpr_models.model import VprModel, build_vpr_model
from shared.errors import Conflict

NETWORK = {
    "backbone_arch": "resnet18",
    "layers_to_crop": [3, 4],
    "agg_arch": "ConvAP",
    "agg_config": {"out_channels": 8},
    "image_size": [64, 64],
}


def make(**arguments: Any) -> VprModel:
    torch.manual_seed(1)
    return make_model(build_arguments(NETWORK | arguments), NullDisplay(), resuming=False)


@pytest.fixture
def published(tmp_path: Path) -> Path:
    """Tensors of Conv-AP with random weights, as gsv-cities publishes them."""
    torch.manual_seed(0)
    config = build_model_config(build_arguments(NETWORK | {"pretrained": False}))
    names = {
        "backbone.stem.0.": "backbone.model.conv1.",
        "backbone.stem.1.": "backbone.model.bn1.",
        "backbone.stages.0.": "backbone.model.layer1.",
        "backbone.stages.1.": "backbone.model.layer2.",
        "aggregator.channels.": "aggregator.channel_pool.",
    }
    tensors = {}
    for name, tensor in build_vpr_model(config).state_dict().items():
        ours = next(ours for ours in names if name.startswith(ours))
        tensors[names[ours] + name.removeprefix(ours)] = tensor
    torch.save(tensors, tmp_path / "convap.ckpt")
    return tmp_path / "convap.ckpt"


@pytest.mark.parametrize("argument", ["weights", "model_path"])
def test_a_run_starts_with_the_weights_of_a_published_network(
    argument: str, published: Path
) -> None:
    model = make(**{argument: str(published)}, layers_to_freeze=1)
    tensors = torch.load(published, weights_only=True)
    stored = model.state_dict()
    assert torch.equal(stored["backbone.stem.0.weight"], tensors["backbone.model.conv1.weight"])
    assert torch.equal(stored["aggregator.channels.bias"], tensors["aggregator.channel_pool.bias"])
    trained = {name for name, each in model.named_parameters() if each.requires_grad}
    assert "aggregator.channels.weight" in trained
    assert "backbone.stages.0.0.conv1.weight" not in trained


def test_a_checkpoint_of_another_network_names_the_arguments_to_pass(published: Path) -> None:
    with pytest.raises(Conflict) as refused:
        make(weights=str(published), agg_config={"out_channels": 4}, layers_to_crop=[4])
    assert refused.value.code == "run_differs"
    assert "--layers_to_crop '[3]'" in refused.value.detail
    assert '"out_channels": 8' in refused.value.detail


@pytest.mark.parametrize("interpolation", ["bilinear", "bicubic"])
def test_weights_of_photos_that_are_resized_otherwise_are_a_warning(
    interpolation: str, published: Path
) -> None:
    display = NullDisplay()
    arguments = {"weights": str(published), "interpolation": interpolation}
    make_model(build_arguments(NETWORK | arguments), display, resuming=False)
    assert len(display.messages) == (interpolation != "bilinear")
    assert all("--interpolation bilinear" in warning for warning in display.messages)


def test_the_size_of_photos_is_a_difference_for_mixvpr_only(tmp_path: Path) -> None:
    for aggregator in ("MixVPR", "GeM"):
        arguments = build_arguments(
            NETWORK | {"pretrained": False, "agg_arch": aggregator, "agg_config": {}}
        )
        stored = build_vpr_model(build_model_config(arguments))
        torch.save(checkpoint_state(stored), tmp_path / f"{aggregator}.ckpt")
    other = {"agg_config": {}, "image_size": [96, 96]}
    make(weights=str(tmp_path / "GeM.ckpt"), agg_arch="GeM", **other)
    with pytest.raises(Conflict, match=r"--image_size '\[64, 64\]'"):
        make(weights=str(tmp_path / "MixVPR.ckpt"), agg_arch="MixVPR", **other)
