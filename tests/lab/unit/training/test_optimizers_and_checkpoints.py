"""Learning rate, optimisers, checkpoint names, the best checkpoints, devices."""

from __future__ import annotations

import math
import random
from pathlib import Path

import numpy as np
import pytest
import torch

from lab.training.arguments import TrainingArguments
from lab.training.checkpointing import (
    CheckpointNameTemplate,
    TopKCheckpoints,
    format_folder,
    restore_rng_state,
    rng_state,
)
from lab.training.resolve import check_loggers, make_fabric
from lab.training.training_loop import learning_rate, make_optimizer
from tests.lab.unit.data_sets import refused

STEPS_PER_EPOCH = 626


@pytest.mark.parametrize(
    ("step", "expected"),
    [
        (0, 2e-4 / 600),
        (299, 1e-4),
        (600, 2e-4),
        (3130, 6e-5),
        (18780, 1.62e-6),
    ],
)
def test_the_rate_rises_over_the_warm_up_and_falls_at_milestones(
    step: int, expected: float
) -> None:
    assert learning_rate(step, STEPS_PER_EPOCH, TrainingArguments()) == pytest.approx(expected)


def test_milestones_within_the_warm_up_count_unless_compatible() -> None:
    for compatible, factor in ((False, 0.09), (True, 0.3)):
        arguments = TrainingArguments(milestones=(0, 2), warmpup_steps=100, compatible=compatible)
        rate = learning_rate(2 * STEPS_PER_EPOCH, STEPS_PER_EPOCH, arguments)
        assert rate == pytest.approx(2e-4 * factor)
    assert learning_rate(0, STEPS_PER_EPOCH, TrainingArguments(warmpup_steps=0)) == 2e-4


@pytest.mark.parametrize(
    ("name", "kind"),
    [("adam", torch.optim.Adam), ("adamw", torch.optim.AdamW), ("sgd", torch.optim.SGD)],
)
def test_each_optimiser_is_what_its_name_says(name: str, kind: type) -> None:
    network = torch.nn.Linear(2, 2)
    network.bias.requires_grad_(False)
    arguments = TrainingArguments(optimizer=name, momentum=0.7, weight_decay=0.1)
    made = make_optimizer(network.parameters(), arguments)
    assert type(made) is kind
    assert [len(group["params"]) for group in made.param_groups] == [1]  # frozen ones are left out
    assert made.param_groups[0]["weight_decay"] == 0.1
    if name == "sgd":
        assert made.param_groups[0]["momentum"] == 0.7


METRICS = ("sfxs_val/R1", "sfxs_val/R5")
FIGURES = {"sfxs_val/R1": 0.81, "sfxs_val/R5": 0.8927, "epoch": 7, "step": 5000}
PUBLISHED = (
    "{self.backbone_arch}_epoch({epoch:02d})_step({step:04d})"
    "_R1[{pitts30k_val/R1:.4f}]_R5[{sfxs_val/R5:.4f}]"
)


def template(text: str, *, insert_names: bool = False) -> CheckpointNameTemplate:
    return CheckpointNameTemplate(
        text,
        {"backbone_arch": "resnet18", "lr": 0.0002},
        METRICS,
        monitored_set="sfxs_val",
        insert_names=insert_names,
    )


def test_a_name_carries_the_figures_drops_what_no_run_logs_and_is_no_path() -> None:
    made = template(PUBLISHED)
    assert made.dropped_fields == ["pitts30k_val/R1"]
    assert made.format_name(FIGURES) == "resnet18_epoch(07)_step(5000)_R5[0.8927]"
    predecessors = "{model.encoder_arch}_epoch({epoch:02d})_R1[{R1:.4f}]_R5[{sfxs_val/R5:.4f}]"
    assert template(predecessors).dropped_fields == []
    assert template(predecessors).format_name(FIGURES) == "resnet18_epoch(07)_R1[0.8100]_R5[0.8927]"
    assert template("{sfxs_val/R1:.2f}/x").format_name(FIGURES) == "0.81-x"
    inserted = template("{sfxs_val/R1:.2f}", insert_names=True)
    assert inserted.format_name(FIGURES) == "sfxs_val-R1=0.81"


def test_templates_without_a_known_field_or_with_a_wrong_format_are_refused() -> None:
    for text in ("{pitts30k_val/R1}", ""):
        with refused("bad_argument", "has no known field"):
            template(text)
    with refused("bad_argument", "cannot format"):
        template("{epoch:02d}_{sfxs_val/R1:02d}").format_name(FIGURES)
    assert format_folder("./LOGS/{self.backbone_arch}", {"backbone_arch": "a/b"}) == "./LOGS/a-b"
    with refused("bad_argument", "not a training argument"):
        format_folder("./LOGS/{epoch}", {})


def checkpoints_in(folder: Path, *, top_k: int = 2, mode: str = "max") -> TopKCheckpoints:
    name = CheckpointNameTemplate("e{epoch}", {}, ["s/R1"])
    return TopKCheckpoints(folder, name, "s/R1", mode, top_k, True)


def write(path: Path, weights_only: bool) -> None:
    path.write_text("weights" if weights_only else "everything")


@pytest.mark.parametrize(
    ("mode", "top_k", "stay"),
    [
        ("max", 2, ["e2", "e4"]),
        ("min", 2, ["e0", "e3"]),
        ("max", -1, ["e0", "e1", "e2", "e3", "e4"]),
        ("max", 0, []),
    ],
)
def test_the_best_checkpoints_stay(tmp_path: Path, mode: str, top_k: int, stay: list[str]) -> None:
    checkpoints = checkpoints_in(tmp_path, mode=mode, top_k=top_k)
    for epoch, score in enumerate((0.1, 0.5, 0.9, 0.3, 0.7)):
        checkpoints.save_if_best(write, {"s/R1": score}, epoch, step=epoch)
    assert sorted(path.stem for path in tmp_path.glob("*")) == stay


def test_of_equal_scores_the_earlier_checkpoint_is_the_best(tmp_path: Path) -> None:
    checkpoints = checkpoints_in(tmp_path, top_k=1)
    assert checkpoints.save_if_best(write, {"s/R1": 0.5}, 0, 0)
    assert not checkpoints.save_if_best(write, {"s/R1": 0.5}, 1, 1)
    assert not checkpoints.save_if_best(write, {"s/R1": math.nan}, 2, 2)
    assert checkpoints.best_path == tmp_path / "e0.ckpt"


def test_checkpoints_of_one_name_are_numbered_and_the_last_one_holds_everything(
    tmp_path: Path,
) -> None:
    name = CheckpointNameTemplate("same{lr}", {"lr": 1}, ["s/R1"])
    checkpoints = TopKCheckpoints(tmp_path, name, "s/R1", "max", 3, True)
    for epoch in range(3):
        checkpoints.save_if_best(write, {"s/R1": 0.5}, epoch, 0)
    assert [path.read_text() for path in tmp_path.glob("*.ckpt")] == ["weights"] * 3
    checkpoints.save_last(write)
    assert checkpoints.last_path.read_text() == "everything"


def test_random_numbers_continue_from_the_stored_state() -> None:
    state = rng_state()
    drawn = (torch.rand(3).tolist(), np.random.rand(3).tolist(), random.random())
    restore_rng_state(state)
    assert (torch.rand(3).tolist(), np.random.rand(3).tolist(), random.random()) == drawn


@pytest.mark.parametrize(
    ("values", "code"),
    [
        ({"devices": 2}, "several_devices"),
        ({"devices": (0, 1)}, "several_devices"),
        ({"precision": "8-bit"}, "unknown_precision"),
        ({"precision": 16}, "needs_gpu"),
        ({"accelerator": "cuda"}, "no_gpu"),
    ],
)
def test_unsupported_options_of_a_device_are_reported(
    values: dict[str, object], code: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with refused(code):
        make_fabric(TrainingArguments(**{"accelerator": "cpu", **values}))


def test_a_logger_whose_package_is_missing_is_named() -> None:
    with refused("logger_missing", "no_such_logger"):
        check_loggers(("csv", "no_such_logger"))
