"""Backbones, aggregators, losses and miners of the user, named by module path."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from pytorch_metric_learning import losses, miners

from lab.training.arguments import TrainingArguments, build_arguments
from lab.training.losses import make_loss, make_miner
from lab.training.model_factory import make_model, register_own_modules
from lab.training.run_control import NullDisplay
from shared.descriptors.aggregators import AGGREGATORS
from shared.descriptors.vpr_models.checkpoint import checkpoint_state, load_checkpoint
from shared.descriptors.vpr_models.config import STAGES
from shared.descriptors.vpr_models.model import VprModel
from tests.lab.unit.data_sets import refused

CODE = """
import torch
from pytorch_metric_learning import losses, miners
from shared.descriptors.aggregators.base import Aggregator, normalise_rows


def small_network(pretrained):
    return torch.nn.Conv2d(3, 6 if pretrained else 5, kernel_size=4, stride=4)


def flat_network(pretrained):
    return torch.nn.Flatten()


class Strongest(Aggregator):
    inferred = {"in_channels": "channels"}

    def __init__(self, in_channels: int, scale: float = 1.0):
        super().__init__(in_channels)
        self.scale = torch.nn.Parameter(torch.tensor(scale))

    def forward(self, maps):
        return normalise_rows(self.scale * maps.amax((-2, -1)))


class NoAggregator(torch.nn.Module):
    pass


MyLoss = losses.ContrastiveLoss
MyMiner = miners.BatchHardMiner


def learned_loss():
    return losses.ArcFaceLoss(num_classes=3, embedding_size=8)


not_callable = 3
"""


@pytest.fixture(autouse=True)
def _own_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A module in the working directory; nothing that it registers outlives the test."""
    (tmp_path / "walks.py").write_text(CODE)
    (tmp_path / "broken.py").write_text("import nothing_of_that_name")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    aggregators, stages = dict(AGGREGATORS), dict(STAGES)
    yield
    sys.modules.pop("walks", None)
    for known, before in ((AGGREGATORS, aggregators), (STAGES, stages)):
        for name in known.keys() - before.keys():
            del known[name]


def arguments_of(**values: Any) -> TrainingArguments:
    network = {
        "backbone_arch": "walks:small_network",
        "agg_arch": "walks:Strongest",
        "layers_to_freeze": -1,
        "image_size": 32,
        "pretrained": False,
    }
    return build_arguments(network | values)


def make_own(arguments: TrainingArguments) -> VprModel:
    register_own_modules(arguments)
    return make_model(arguments, NullDisplay(), resuming=False)


def test_own_backbone_and_aggregator_make_a_network_whose_checkpoint_needs_them_again(
    tmp_path: Path,
) -> None:
    model = make_own(arguments_of(agg_config={"scale": 2.0}))
    assert model.dimension == 5
    assert model.config.agg_config == {"scale": 2.0, "in_channels": 5}
    rows = model(torch.rand(2, 3, 32, 32))
    assert torch.allclose(rows.norm(dim=1), torch.ones(2))
    rows.sum().backward()
    assert all(parameter.grad is not None for parameter in model.parameters())

    path = tmp_path / "own.ckpt"
    torch.save(checkpoint_state(model), path)
    assert torch.equal(load_checkpoint(path).model(torch.ones(1, 3, 32, 32)),
                       model.eval()(torch.ones(1, 3, 32, 32)))  # fmt: skip
    del AGGREGATORS["walks:Strongest"]
    (tmp_path / "walks.py").write_text("raise SystemExit('executed')")
    del sys.modules["walks"]
    with refused("own_module_unknown", "walks:Strongest"):
        load_checkpoint(path)
    assert "walks" not in sys.modules, "loading a checkpoint never imports code"


def test_an_own_backbone_is_frozen_as_a_whole_and_gets_the_choice_of_weights() -> None:
    model = make_own(arguments_of(layers_to_freeze=0, pretrained=True, agg_arch="GeM"))
    assert model.dimension == 6, "pretrained weights were requested"
    assert not any(p.requires_grad for p in model.backbone.parameters())
    with refused("bad_model_config", "0 stages"):
        make_own(arguments_of(layers_to_freeze=1))


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"agg_arch": "walks:NoAggregator"}, "not a subclass of Aggregator"),
        ({"agg_arch": "walks:Nowhere"}, "AttributeError"),
        ({"agg_arch": "nowhere:Strongest"}, "ModuleNotFoundError"),
        ({"agg_arch": "broken:Strongest"}, "nothing_of_that_name"),
        ({"backbone_arch": "walks:not_callable"}, "not a class or function"),
    ],
)
def test_own_code_that_can_not_be_used_is_named_with_the_reason(
    values: dict[str, str], reason: str
) -> None:
    with refused("own_module_unusable", f"{next(iter(values.values()))}.*{reason}"):
        make_own(arguments_of(**values))


def test_an_own_backbone_that_makes_no_maps_is_an_error() -> None:
    with refused("backbone_unusable", r"\(1, 3072\)"):
        make_own(arguments_of(backbone_arch="walks:flat_network"))


def test_own_losses_and_miners_are_made_without_arguments() -> None:
    assert isinstance(make_loss("walks:MyLoss"), losses.ContrastiveLoss)
    assert isinstance(make_miner("walks:MyMiner"), miners.BatchHardMiner)
    unusable = "own_module_unusable"
    with refused(unusable, "parameters of its own"):
        make_loss("walks:learned_loss")
    with refused(unusable, "argument"):
        make_loss("walks:Strongest")
    with refused(unusable, r"torch\.nn\.Module"):
        make_miner("builtins:dict")
