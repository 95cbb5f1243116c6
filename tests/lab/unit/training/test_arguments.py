"""The arguments of `placewise train`: the predecessor's names, defaults and published command."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import pytest
import torch
import typer
from typer.testing import CliRunner

from lab.cli.training.options import given_options, with_training_options
from lab.training.arguments import (
    CITIES,
    TrainingArguments,
    build_arguments,
    load_yaml,
    save_yaml,
    to_plain_dict,
)
from lab.training.resolve import list_changed_meanings, make_fabric
from shared.errors import InvalidRequest
from tests.lab.training_runs import PUBLISHED_COMMAND
from tests.lab.unit.data_sets import refused
from tests.support.commands import run

PREDECESSORS: dict[str, Any] = {
    "backbone_arch": "resnet18",
    "pretrained": True,
    "layers_to_freeze": 2,
    "layers_to_crop": (),
    "agg_arch": "AVG",
    "agg_config": {},
    "lr": 2e-4,
    "optimizer": "adam",
    "weight_decay": 0,
    "momentum": 0.9,
    "warmpup_steps": 600,
    "milestones": (5, 10, 15, 25),
    "lr_mult": 0.3,
    "loss_name": "MultiSimilarityLoss",
    "miner_name": "MultiSimilarityMiner",
    "miner_margin": 0.1,
    "faiss_gpu": True,
    "cities": CITIES,
    "batch_size": 64,
    "img_per_place": 2,
    "min_img_per_place": 2,
    "shuffle_all": False,
    "random_sample_from_each_place": True,
    "image_size": (320, 320),
    "num_workers": 8,
    "show_data_stats": True,
    "val_set_names": ("sfxs_val",),
    "test_set_names": ("sfxs_test", "tokyoxs_test"),
    "model_path": None,
    "experiment_phase": "train",
    "monitor": "sfxs_val/R1",
    "auto_insert_metric_name": False,
    "save_weights_only": True,
    "save_top_k": 3,
    "mode": "max",
    "accelerator": "auto",
    "devices": (0,),
    "default_root_dir": "./LOGS/",
    "num_sanity_val_steps": 0,
    "precision": 32,
    "max_epochs": 1,
    "check_val_every_n_epoch": 1,
    "reload_dataloaders_every_n_epochs": 1,
    "log_every_n_steps": 20,
    "fast_dev_run": False,
}


def read(tokens: list[str]) -> TrainingArguments:
    """What the command makes of its tokens."""
    given: dict[str, str] = {}

    @with_training_options
    def command(**arguments: Any) -> None:
        given.update(given_options(arguments))

    app = typer.Typer()
    app.command(**command.command_settings)(command)  # type: ignore[attr-defined]
    answer = CliRunner().invoke(app, tokens)
    assert answer.exit_code == 0, answer.output
    return build_arguments(given)


def test_every_argument_of_the_predecessor_is_there_with_its_default() -> None:
    assert {name: getattr(TrainingArguments(), name) for name in PREDECESSORS} == PREDECESSORS


def test_the_published_command_has_the_settings_of_its_authors() -> None:
    arguments = read(shlex.split(PUBLISHED_COMMAND))
    assert arguments.batch_size == 100
    assert arguments.image_size == (320, 320)
    assert arguments.val_set_names == ("sfxs_val",)
    assert arguments.test_set_names == ("sfxs_test", "tokyoxs_test")
    assert arguments.layers_to_freeze == -1
    assert arguments.layers_to_crop == (4,)
    assert arguments.agg_config == {"p": 3}
    assert arguments.milestones == (5, 10, 15, 25)
    assert arguments.shuffle_all is False
    assert arguments.auto_insert_metric_name is False
    assert arguments.model_path is None
    assert arguments.devices == 1
    assert arguments.precision == 32
    assert "\\" not in arguments.filename


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU here")
def test_the_accelerator_auto_trains_without_a_gpu() -> None:
    arguments = read(["--accelerator", "auto", "--data-root", "."])
    assert make_fabric(arguments).device.type in ("cpu", "mps")


def test_compatible_arguments_have_the_effect_that_they_had_in_the_predecessor() -> None:
    published = shlex.split(PUBLISHED_COMMAND)
    arguments = read([*published, "--compatible", "--layers_to_freeze", "2"])
    assert arguments.optimizer == "adamw"
    assert arguments.layers_to_freeze == -1
    assert arguments.test_image_size == "native"
    (line,) = list_changed_meanings(arguments)
    assert "--optimizer adamw" in line
    assert build_arguments(to_plain_dict(arguments)) == arguments, "also when a run is resumed"
    chosen = read([*published, "--compatible", "--optimizer", "sgd", "--test_image_size", "same"])
    assert (chosen.optimizer, chosen.test_image_size) == ("sgd", "same")


def test_validation_photos_have_the_size_of_training_unless_it_is_given() -> None:
    assert read([]).evaluation_size == (320, 320)
    assert read(["--val_image_size", "224", "448"]).evaluation_size == (224, 448)
    with pytest.raises(InvalidRequest, match="32 pixels or more"):
        read(["--val_image_size", "16"])


@pytest.mark.parametrize(
    ("tokens", "pretrained"),
    [
        (["--pretrained", "False"], False),
        (["--pretrained=false"], False),
        (["--no_pretrained"], False),
        (["--pretrained", "--lr", "0.1"], True),
        (["--no-pretrained", "--pretrained"], True),
    ],
)
def test_boolean_words_are_parsed(tokens: list[str], pretrained: bool) -> None:
    assert read(tokens).pretrained is pretrained


@pytest.mark.parametrize(
    ("tokens", "name", "value"),
    [
        (["--warmup-steps", "3"], "warmpup_steps", 3),
        (["--agg-config", '{"p": 2}'], "agg_config", {"p": 2}),
        (["--val_set_names", "['a', 'b']"], "val_set_names", ("a", "b")),
        (["--val_set_names", "a,b"], "val_set_names", ("a", "b")),
        (["--val_set_names", "[]"], "val_set_names", ()),
        (["--val_set_names", "2023"], "val_set_names", ("2023",)),
        (["--test_image_size", "480", "640"], "test_image_size", (480, 640)),
        (["--image_size", "224x336"], "image_size", (224, 336)),
        (["--image-size", "224", "336", "--lr", "1"], "image_size", (224, 336)),
        (["--devices", "[1]"], "devices", (1,)),
        (["--precision", "16-mixed"], "precision", "16-mixed"),
        (["--logger", "none"], "logger", ()),
        (["--layers_to_crop", "4"], "layers_to_crop", (4,)),
    ],
)
def test_lists_sizes_and_words_are_read(tokens: list[str], name: str, value: object) -> None:
    assert getattr(read(tokens), name) == value


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("pretrained", "maybe", "Expected True or False"),
        ("layers_to_crop", "layer4", r"Expected a JSON list, such as \[4\]"),
        ("image_size", "16", "32 pixels or more"),
        ("agg_config", "{p: 3", "valid dictionary"),
    ],
)
def test_an_invalid_value_names_its_argument(name: str, text: str, message: str) -> None:
    with pytest.raises(InvalidRequest, match=message) as caught:
        build_arguments({name: text})
    assert f"--{name}" in caught.value.detail


def test_a_word_after_a_boolean_option_is_its_value() -> None:
    answer = run("train", "--shuffle_all", "maybe", code=1)
    shown = answer.output.replace("\n", " ")
    assert "--shuffle_all" in shown
    assert "Expected True or False (got 'maybe')" in shown
    answer = run("train", "--batchsize", "3", code=2)
    assert "--batch-size" in answer.output, "the nearest option is suggested"


def test_options_override_the_file(tmp_path: Path) -> None:
    file = tmp_path / "run.yaml"
    file.write_text("batch-size: 8\nlr: 0.001\nimage_size: [64, 96]\nval_set_names: [a]\n")
    arguments = build_arguments(load_yaml(file), {"lr": "0.5"})
    assert (arguments.lr, arguments.batch_size) == (0.5, 8)
    assert (arguments.image_size, arguments.val_set_names) == ((64, 96), ("a",))


@pytest.mark.parametrize(
    ("text", "code", "message"),
    [
        ("milestone: [3]\n", "unknown_argument", r"run\.yaml.*milestones"),
        ("- lr\n", "bad_config", "mapping of names to values"),
        (None, "config_not_found", "Can't read"),
    ],
)
def test_files_that_hold_no_arguments_are_refused(
    text: str | None, code: str, message: str, tmp_path: Path
) -> None:
    file = tmp_path / "run.yaml"
    if text is not None:
        file.write_text(text)
    with refused(code, message):
        load_yaml(file)


def test_a_written_configuration_is_read_as_the_same_run(tmp_path: Path) -> None:
    arguments = read(shlex.split(PUBLISHED_COMMAND))
    save_yaml(arguments, tmp_path / "config.yaml")
    assert build_arguments(load_yaml(tmp_path / "config.yaml")) == arguments


def test_values_that_had_another_effect_in_the_predecessor_are_named() -> None:
    published = read(shlex.split(PUBLISHED_COMMAND))
    assert list_changed_meanings(published) == [], "without weight decay, Adam is AdamW"
    differing = build_arguments(
        {"optimizer": "adam", "weight_decay": 0.1, "experiment_phase": "all", "image_size": 224}
    )
    adam, size, frozen = list_changed_meanings(differing)
    assert "--optimizer adamw" in adam
    assert "224 x 224" in size
    assert "--test_image_size native" in size
    assert "--layers_to_freeze -1 or --compatible" in frozen
