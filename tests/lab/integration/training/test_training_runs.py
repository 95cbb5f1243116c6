"""Whole training runs on places drawn in a moment, on the processor."""

from __future__ import annotations

import json
import re
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from lab.training import run
from lab.training.arguments import build_arguments, load_yaml
from lab.training.run_control import NullDisplay, RunStopped, StopRequest
from shared.descriptors.aggregators import AGGREGATORS
from shared.descriptors.extractor import Extractor
from shared.descriptors.vpr_models.checkpoint import load_checkpoint
from shared.descriptors.vpr_models.config import STAGES
from shared.errors import Unprocessable
from shared.extractor_config.configs import get_extractor_config
from tests.lab.training_runs import (
    CITY,
    StopAfter,
    assert_same_weights,
    run_arguments,
    train,
    weights,
)
from tests.lab.unit.data_sets import refused
from tests.lab.unit.training.test_own_modules import CODE
from tests.support.commands import run as run_command
from tests.support.commands import run_json

Json = dict[str, Any]
pytestmark = pytest.mark.usefixtures("one_thread")


def test_a_run_leaves_its_summary_configuration_and_checkpoints(whole: tuple[Path, Json]) -> None:
    folder, report = whole
    assert json.loads((folder / "metrics.json").read_text()) == report
    assert [epoch["step"] for epoch in report["epochs"]] == [3, 6]
    recalls = {name.rpartition("/")[2] for name in report["epochs"][0]["figures"]}
    assert recalls == {"R1", "R5", "R10", "R15", "R20"}
    assert report["training_set"]["places"] == 6
    assert report["training_set"]["cities"] == [CITY]
    (name,) = report["sets"]
    assert report["monitor"] == f"{name}/R1"
    assert report["images"] == 2 * 6 * 3
    assert 0 <= report["share_waiting_for_data"] <= 1
    assert build_arguments(load_yaml(folder / "config.yaml")).cities == (CITY,)
    assert list((folder / "csv").rglob("metrics.csv"))
    assert list((folder / "tensorboard").glob("events*"))


def test_the_best_checkpoints_are_named_by_their_figures_and_the_best_one_is_tested(
    whole: tuple[Path, Json],
) -> None:
    folder, report = whole
    monitor = report["monitor"]
    for epoch in report["epochs"]:
        (found,) = (folder / "checkpoints").glob(f"*epoch({epoch['number']:02d})*.ckpt")
        assert f"R1[{epoch['figures'][monitor]:.4f}]" in found.name
    best = max(report["epochs"], key=lambda each: each["figures"][monitor])
    assert f"epoch({best['number']:02d})" in report["best"]["path"]
    (name,) = report["test"]
    # Tested at the size of training, on the set that it was validated on: the same figures.
    for k, share in report["test"][name]["recall"].items():
        assert share == best["figures"][f"{name}/R{k}"]
    path = Path(report["best"]["path"])
    assert load_checkpoint(path).fingerprint == report["best"]["fingerprint"]
    assert "optimizer_states" not in torch.load(path, weights_only=True)
    last = torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)
    assert last["optimizer_states"]


def test_tests_and_on_demand_validations_leave_predictions_that_evaluate_reads(
    places: Path, tmp_path: Path
) -> None:
    report = train(
        run_arguments(places, tmp_path, experiment_phase="all", save_val_predictions=True)
    )
    (name,) = report["predictions"]
    folder = tmp_path / "run"
    files = [folder / f"predictions_{name}.npy"]
    files += [folder / f"predictions/epoch{n:02d}/predictions_{name}.npy" for n in (0, 1)]
    recalls = [report["test"][name]["recall"]]
    recalls += [
        {k: epoch["figures"][f"{name}/R{k}"] for k in ("1", "5", "10", "20")}
        for epoch in report["epochs"]
    ]
    for file, recall in zip(files, recalls, strict=True):
        evaluated = run_json("evaluate", "--predictions", file, "--data", places, "--set", name)
        assert evaluated["recall"] == {k: recall[k] for k in evaluated["recall"]}
    assert f"--data {places} --set {name}" in report["next"][0]


def test_a_compiled_network_learns_the_same_and_leaves_an_ordinary_checkpoint(
    whole: tuple[Path, Json], places: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiled: list[torch.nn.Module] = []
    real = torch.compile

    def compile_without_code(module: torch.nn.Module, **options: Any) -> Any:
        compiled.append(module)
        return real(module, **{**options, "backend": "eager"})  # the compiler takes a minute

    monkeypatch.setattr(torch, "compile", compile_without_code)
    report = train(run_arguments(places, tmp_path, compile=True))
    assert compiled
    assert_same_weights(whole[0] / "checkpoints/last.ckpt", Path(report["last"]))
    assert load_checkpoint(Path(report["best"]["path"])).fingerprint


def test_the_trained_model_keeps_the_size_and_the_interpolation_of_its_validation(
    places: Path, tmp_path: Path
) -> None:
    fields = run_arguments(
        places, tmp_path, val_image_size=[48, 64], interpolation="bicubic",
        randaugment_magnitude=5, max_steps=1, experiment_phase="all"
    )  # fmt: skip
    best = Path(train(fields)["best"]["path"])
    config = load_checkpoint(best).config
    assert (config.image_size, config.interpolation) == ((48, 64), "bicubic")
    served = Extractor(
        get_extractor_config(f"gsv:{best}", allow_test_extractors=False), torch.device("cpu")
    )
    assert served.preprocessing.name == "resize48x64-bicubic"


def test_own_code_is_trained_stopped_resumed_and_tested_by_its_name(
    places: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "own_walks.py").write_text(CODE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    backbone, aggregator = "own_walks:small_network", "own_walks:Strongest"
    own: Json = {
        "backbone_arch": backbone,
        "layers_to_crop": [],
        "agg_arch": aggregator,
        "loss_name": "pytorch_metric_learning.losses:ContrastiveLoss",
        "miner_name": "pytorch_metric_learning.miners:BatchHardMiner",
        "experiment_phase": "all",
    }
    fields = run_arguments(places, tmp_path, **own)
    stop = StopRequest()
    with pytest.raises(RunStopped):
        run.run(build_arguments(fields), StopAfter(stop, "epoch 1", 2), stop)
    monkeypatch.delitem(AGGREGATORS, aggregator)  # as in another process
    report = run.resume(tmp_path / "run", {}, NullDisplay(), StopRequest())
    assert not [line for line in report["next"] if "models add" in line]
    tested = train(
        {**fields, "experiment_phase": "test", "run_name": "t", "model_path": report["last"]}
    )
    assert tested["test"].keys() == report["test"].keys()
    del AGGREGATORS[aggregator], STAGES[backbone]


def test_frozen_layers_keep_their_weights_and_the_others_learn(
    places: Path, tmp_path: Path
) -> None:
    display = NullDisplay()
    fields = run_arguments(places, tmp_path, layers_to_freeze=0, max_steps=2)
    report = train(fields, display)
    begun = train(
        run_arguments(places, tmp_path, layers_to_freeze=0, lr=1e-30, max_steps=1, run_name="0")
    )
    before, after = weights(Path(begun["last"])), weights(Path(report["last"]))
    changed = {name for name in before if not torch.allclose(before[name], after[name])}
    assert changed
    assert not [name for name in changed if "stem" in name]
    assert any("stem" in name for name in before)
    assert any("never learn" in line for line in display.messages)


def test_a_photo_that_does_not_decode_is_named_and_counted(places: Path, tmp_path: Path) -> None:
    mine = Path(shutil.copytree(places, tmp_path / "places"))
    broken = sorted((mine / "gsv_xs" / "train" / CITY).iterdir())[0]
    broken.write_bytes(broken.read_bytes()[:100])
    display = NullDisplay()
    fields = run_arguments(mine, tmp_path, random_sample_from_each_place=False, max_epochs=1)
    report = train(fields, display)
    assert list(report["bad_photos"]) == [str(broken)]
    assert report["images"] == 17
    assert any(broken.name in line for line in display.messages)
    with refused("undecodable_photo", broken.name[:20]):
        train({**fields, "on_bad_image": "error", "run_name": "strict"})


def test_a_checkpoint_alone_is_tested(
    whole: tuple[Path, Json], places: Path, tmp_path: Path
) -> None:
    _, trained = whole
    best = trained["best"]["path"]
    fields = run_arguments(places, tmp_path, experiment_phase="test", model_path=best)
    del fields["image_size"]  # the checkpoint knows it
    report = train(fields)
    assert report["test"] == trained["test"]
    assert all(Path(file).is_file() for file in report["predictions"].values())
    native = train({**fields, "test_image_size": "native", "run_name": "native"})
    assert native["test"].keys() == trained["test"].keys()
    with refused("model_path_missing", "--model_path"):
        train({**fields, "model_path": "", "run_name": "none"})


def test_a_fast_dev_run_leaves_nothing(places: Path, tmp_path: Path) -> None:
    train(run_arguments(places, tmp_path / "out", fast_dev_run=True, num_sanity_val_steps=1))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("others", "code", "expected"),
    [
        ({"monitor": "other/R1"}, "unknown_metric", "known: "),
        ({"img_per_place": 4}, "bad_argument", "min_img_per_place"),
    ],
)
def test_what_is_not_there_is_named_with_what_is_known(
    others: Json, code: str, expected: str, places: Path, tmp_path: Path
) -> None:
    with refused(code, re.escape(expected)):
        train(run_arguments(places, tmp_path, **others))


def test_a_diverged_training_ends_with_an_error_that_says_so(places: Path, tmp_path: Path) -> None:
    fields = run_arguments(places, tmp_path, optimizer="sgd", lr=1e30, warmpup_steps=0)
    with pytest.raises(Unprocessable) as caught:
        train(fields)
    assert caught.value.code in ("loss_not_finite", "features_not_finite")


def test_the_grid_command_makes_every_run_names_the_failed_one_and_ranks_the_others(
    places: Path, tmp_path: Path
) -> None:
    fields = run_arguments(places, tmp_path, max_epochs=1)
    del fields["default_root_dir"], fields["run_name"], fields["agg_arch"]
    file = tmp_path / "grid.yaml"
    mixvpr = {"agg_arch": "MixVPR", "agg_config": {"nonsense": 1}}
    file.write_text(
        json.dumps({"base": fields, "grid": {"agg": [{"agg_arch": "AVG"}, {"agg_arch": "GeM"}]},
                    "runs": [{"name": "wrong", **mixvpr}]})
    )  # fmt: skip
    out = tmp_path / "grid"
    command = ["grid", file, "--out", out, "--json"]
    dry = run_command(*command, "--dry-run", code=1)
    assert "wrong can't start: bad_agg_config" in dry.stderr
    assert [(row["run"], row["state"]) for row in json.loads(dry.stdout)] == [
        ("AVG", "waiting"),
        ("GeM", "waiting"),
        ("wrong", "waiting"),
    ]
    assert not out.exists()
    answer = run_command(*command, code=1)
    states = {each["run"]["name"]: each["state"] for each in json.loads(answer.stdout)}
    assert states == {"AVG": "finished", "GeM": "finished", "wrong": "failed"}
    assert "wrong failed: bad_agg_config" in answer.stderr.replace("\n", " ")
    table = (out / "leaderboard.md").read_text()
    assert table.index("AVG") < table.index("wrong")
    assert "failed: bad_agg_config" in table
