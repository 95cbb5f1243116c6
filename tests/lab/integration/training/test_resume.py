"""Interrupted training runs go on, and refuse what contradicts their training."""

from __future__ import annotations

import csv
import io
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch

from lab.training import run
from lab.training.arguments import build_arguments
from lab.training.grid import GridPlan, run_grid
from lab.training.run_control import NullDisplay, RunStopped, StopRequest
from lab.training.run_folder import lock_folder
from shared.errors import Conflict, PlacewiseError
from tests.lab.training_runs import StopAfter, assert_same_weights, run_arguments, write_tiny_places
from tests.lab.unit.data_sets import refused

Json = dict[str, Any]
pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.mark.parametrize(
    ("what", "times"),
    [("epoch 1", 2), ("epoch 1", 3), ("epoch 2", 1), ("places", 1), ("places", 4)],
    ids=["in an epoch", "at its last step", "in the next", "measuring", "measuring the last"],
)
def test_a_run_that_was_stopped_goes_on_as_if_it_had_not_been(
    what: str, times: int, whole: tuple[Path, Json], places: Path, tmp_path: Path
) -> None:
    folder, report = whole
    stop = StopRequest()
    (name,) = report["sets"]
    display = StopAfter(stop, name if what == "places" else what, times)
    with pytest.raises(RunStopped):
        run.run(build_arguments(run_arguments(places, tmp_path)), display, stop)
    resumed = run.resume(tmp_path / "run", {}, NullDisplay(), StopRequest())
    assert [epoch["figures"] for epoch in resumed["epochs"]] == [
        epoch["figures"] for epoch in report["epochs"]
    ]
    assert resumed["images"] == report["images"]
    assert_same_weights(folder / "checkpoints/last.ckpt", Path(resumed["last"]))
    assert_same_weights(Path(report["best"]["path"]), Path(resumed["best"]["path"]))


@pytest.fixture
def copy(whole: tuple[Path, Json], tmp_path: Path) -> Path:
    """The finished run, to be damaged."""
    return Path(shutil.copytree(whole[0], tmp_path / "run"))


def test_a_finished_run_learns_longer_and_continues_its_csv_file(copy: Path) -> None:
    changes = {"max_epochs": 3, "logger": "csv", "experiment_phase": "train"}
    report = run.resume(copy, changes, NullDisplay(), StopRequest())
    assert [epoch["number"] for epoch in report["epochs"]] == [0, 1, 2]
    (file,) = (copy / "csv").rglob("metrics.csv")
    with file.open(newline="") as opened:
        rows = list(csv.DictReader(opened))
    assert [int(row["step"]) for row in rows if row["loss"]] == list(range(1, 10))
    validated = [row["step"] for row in rows if not row["loss"]]
    assert validated == ["3", "6", "9"]


def refusal_of_resume(path: Path, **changes: Any) -> tuple[str, str]:
    """Code and detail of the error with which `--resume` is refused."""
    config = path / "config.yaml"
    before = config.read_bytes() if config.is_file() else None
    with pytest.raises(PlacewiseError) as caught:
        run.resume(path, changes, NullDisplay(), StopRequest())
    assert before is None or config.read_bytes() == before, "a refused resume changes nothing"
    return caught.value.code, caught.value.detail


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"compatible": True}, "optimizer (adam -> adamw)"),
        ({"max_epochs": 1}, "was trained for 6 steps, but the run ends after 3"),
        ({"max_steps": 5}, "ends after 5"),
        ({"batch_size": 3, "lr": 0.5}, "batch_size (2 -> 3), lr (0.001 -> 0.5)"),
    ],
)
def test_a_run_is_not_resumed_with_what_contradicts_its_training(
    copy: Path, changes: Json, reason: str
) -> None:
    code, detail = refusal_of_resume(copy, **changes)
    assert code == "run_differs"
    assert reason in detail


def test_a_run_is_not_resumed_with_other_photos(copy: Path, tmp_path: Path) -> None:
    more = write_tiny_places(tmp_path / "more", places=7)
    code, detail = refusal_of_resume(copy, data_root=str(more))
    assert code == "run_differs"
    assert "are not those that the run" in detail


def test_a_run_is_not_resumed_for_a_test_and_a_trial_step_leaves_it_as_it_was(copy: Path) -> None:
    code, detail = refusal_of_resume(copy, experiment_phase="test")
    assert code == "bad_argument"
    assert "--model_path" in detail
    before = {file: file.read_bytes() for file in copy.rglob("*") if file.is_file()}
    answer = run.resume(copy, {"fast_dev_run": True, "max_epochs": 3}, NullDisplay(), StopRequest())
    assert answer == {"fast_dev_run": True}
    assert {file: file.read_bytes() for file in copy.rglob("*") if file.is_file()} == before


def test_damaged_and_foreign_files_of_a_run_are_clear_errors(copy: Path, places: Path) -> None:
    config, last = copy / "config.yaml", copy / "checkpoints" / "last.ckpt"
    written = config.read_text()
    config.write_text(written.replace("lr: 0.001", "lr: 0.5"))
    assert refusal_of_resume(copy)[0] == "run_differs"
    assert "lr (0.001 -> 0.5)" in refusal_of_resume(copy)[1]
    config.write_text(written)

    data = last.read_bytes()
    last.write_bytes(data[: len(data) // 2])
    assert refusal_of_resume(copy)[0] == "checkpoint_unreadable"
    best = next(file for file in last.parent.iterdir() if file != last)
    last.write_bytes(best.read_bytes())
    code, detail = refusal_of_resume(copy)
    assert code == "checkpoint_unreadable"
    assert "full training state" in detail

    stored = torch.load(io.BytesIO(data), weights_only=True)
    name = next(iter(stored["state_dict"]))
    stored["state_dict"][name] = torch.zeros(1)
    torch.save(stored, last)
    code, detail = refusal_of_resume(copy)
    assert code == "run_differs"
    assert "another network" in detail
    last.unlink()
    assert refusal_of_resume(copy)[0] == "run_not_found"
    last.write_bytes(data)

    (copy / "history.json").write_text('{"training_set": {}, "epochs": [], "best": []}')
    assert refusal_of_resume(copy)[0] == "run_unreadable"
    (copy / "history.json").unlink()
    assert refusal_of_resume(copy)[0] == "run_unreadable"
    config.write_text("lr: [")
    assert refusal_of_resume(copy)[0] == "bad_config"


def test_a_run_or_grid_that_another_process_trains_or_that_can_not_be_locked_is_left_alone(
    copy: Path,
) -> None:
    with lock_folder(copy):
        code, detail = refusal_of_resume(copy, max_epochs=3)
    assert code == "run_in_use"
    assert str(copy) in detail
    plan, nothing = GridPlan((), {}), lambda outcomes: None
    with lock_folder(copy), pytest.raises(Conflict, match="Another process"):
        run_grid(plan, copy, NullDisplay(), StopRequest(), nothing)
    with refused("out_unwritable"), lock_folder(copy / "config.yaml"):
        pass
