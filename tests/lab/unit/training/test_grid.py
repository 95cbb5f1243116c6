"""Grids: which runs a file means, what becomes of them, and their leaderboard."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path
from typing import Any

import pytest

from lab.training import run
from lab.training.arguments import build_arguments, load_yaml, save_yaml, to_plain_dict
from lab.training.grid import GridPlan, PlannedRun, RunState, load_grid_plan, load_outcome, run_grid
from lab.training.leaderboard import leaderboard, write_leaderboard
from lab.training.run_control import Display, NullDisplay, RunStopped, StopRequest
from shared.errors import Conflict, InvalidRequest, Misconfigured
from tests.lab.unit.data_sets import refused

CONFIGS = Path(__file__).parents[4] / "configs"

GRID = """
base: {lr: 0.1, batch-size: 4}
grid:
  aggregator: [{agg_arch: AVG}, {agg_arch: CosPlace, agg_config: {out_dim: 32}}]
  loss_name: [NTXentLoss, FastAPLoss]
runs:
  - {name: alone, loss_name: AngularLoss, published: {sfxs_val/R1: 43.25}}
fingerprints: {sfxs_val: abc}
"""


def plan_of(tmp_path: Path, text: str, **overrides: Any) -> GridPlan:
    file = tmp_path / "grid.yaml"
    file.write_text(text)
    return load_grid_plan(file, overrides)


def test_a_grid_is_every_combination_and_every_listed_run(tmp_path: Path) -> None:
    plan = plan_of(tmp_path, GRID, lr="0.5")
    assert [run.name for run in plan.runs] == [
        "AVG-NTXentLoss",
        "AVG-FastAPLoss",
        "CosPlace-NTXentLoss",
        "CosPlace-FastAPLoss",
        "alone",
    ]
    assert plan.runs[3].arguments == {
        "lr": "0.5",
        "batch_size": 4,
        "agg_arch": "CosPlace",
        "agg_config": {"out_dim": 32},
        "loss_name": "FastAPLoss",
    }
    assert plan.runs[4].published == {"sfxs_val/R1": 43.25}


@pytest.mark.parametrize(
    ("text", "code", "message"),
    [
        ("bases: {}", "bad_grid", "Did you mean base"),
        ("base: {lr: 1}", "bad_grid", "nothing to train"),
        ("grid: {lrr: [1]}", "unknown_argument", "Did you mean lr"),
        ("runs: [{name: a, published: {s/R1: high}}]", "bad_grid", "s/R1: Input should be a"),
        ("runs: [{name: a}, {name: a}]", "bad_grid", "several runs are called a"),
        ("runs: [{name: a, run_name: b}]", "bad_grid", "--out"),
        ("runs: [{name: a, loss_name: Best}]", "unknown_loss", "a: There is no loss"),
        ("runs: [{name: a, agg_arch: Best}]", "unknown_aggregator", "CosPlace"),
        ("runs: [{name: a, batch_size: 0}]", "bad_argument", "--batch_size"),
    ],
)
def test_an_invalid_grid_is_refused_before_its_first_run(
    text: str, code: str, message: str, tmp_path: Path
) -> None:
    with refused(code, re.escape(message)):
        plan_of(tmp_path, text)


def test_the_predecessors_grid_is_its_28_published_runs() -> None:
    plan = load_grid_plan(CONFIGS / "predecessor-grid.yaml", {})
    assert len(plan.runs) == 28
    best = plan.runs[25]
    assert best.name.startswith("26-cosplace-512")
    assert best.arguments["agg_config"] == {"out_dim": 512}
    assert best.published["tokyoxs_test/R1"] == 59.68
    assert sum("sfxs_test/R1" in run.published for run in plan.runs) == 5
    assert all({"sfxs_val/R1", "sfxs_val/R5"} <= run.published.keys() for run in plan.runs)
    assert {run.arguments["max_epochs"] for run in plan.runs} == {8, 30}


@pytest.mark.parametrize("file", sorted(CONFIGS.glob("*.yaml")), ids=lambda file: file.name)
def test_every_example_is_read(file: Path) -> None:
    if file.name.startswith("train-"):
        build_arguments(load_yaml(file))
    else:
        assert load_grid_plan(file, {}).runs


def test_the_grid_of_aggregators_trains_each_as_the_tutorial_trains_boq() -> None:
    tutorial = build_arguments(load_yaml(CONFIGS / "train-boq.yaml"))
    plan = load_grid_plan(CONFIGS / "grid-aggregators.yaml", {})
    runs = [build_arguments(planned.arguments) for planned in plan.runs]
    assert tutorial in runs
    network = {"agg_arch", "agg_config"}
    assert {run.model_dump_json(exclude=network) for run in runs} == {
        tutorial.model_dump_json(exclude=network)
    }


def plain_plan(*names: str) -> GridPlan:
    return GridPlan(tuple(PlannedRun(name, {"loss_name": "NTXentLoss"}) for name in names), {})


class Runs:
    """Trainer whose runs end at once with the given outcome."""

    def __init__(self, out: Path, **endings: Exception | float) -> None:
        self.out, self.endings, self.calls = out, endings, list[str]()
        self.display, self.stop = NullDisplay(), StopRequest()

    def begin(self, arguments: Any, display: Display, stop: StopRequest) -> dict[str, Any]:
        return self._end("begin", self.out / arguments.run_name, arguments)

    def resume(
        self, folder: Path, changes: Any, display: Display, stop: StopRequest
    ) -> dict[str, Any]:
        return self._end("resume", folder, build_arguments({"loss_name": "NTXentLoss"}))

    def _end(self, how: str, folder: Path, arguments: Any) -> dict[str, Any]:
        self.calls.append(f"{how} {folder.name}")
        folder.mkdir(parents=True, exist_ok=True)
        save_yaml(arguments, folder / "config.yaml")
        ending = self.endings[folder.name]
        if isinstance(ending, Exception):
            raise ending
        report = report_of(ending, arguments)
        (folder / "metrics.json").write_text(json.dumps(report))
        return report

    def go(self, plan: GridPlan) -> list[Any]:
        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(run, "run", self.begin)
            patched.setattr(run, "resume", self.resume)
            return run_grid(plan, self.out, self.display, self.stop, lambda outcomes: None)


def report_of(score: float, arguments: Any) -> dict[str, Any]:
    figures = {"s/R1": score, "s/R5": score, "s/R20": 1.0}
    return {
        "arguments": to_plain_dict(arguments),
        "monitor": "s/R1",
        "epochs": [
            {"number": 0, "figures": {"s/R1": score / 2, "s/R5": 0.0}},
            {"number": 1, "figures": figures},
        ],
        "sets": {"s": {"fingerprint": "abc"}},
        "test": {},
        "best": {"path": "x/best.ckpt", "dimension": 128},
        "images_per_second": 10.0,
    }


def test_failed_runs_are_named_with_each_reason_once_and_the_others_are_made(
    tmp_path: Path,
) -> None:
    missing = Misconfigured("weights_missing", "a long sentence")
    runs = Runs(tmp_path, a=0.5, b=RuntimeError("out of memory"), c=missing, d=1, e=missing)
    outcomes = runs.go(plain_plan("a", "b", "c", "d", "e"))
    finished, failed = RunState.FINISHED, RunState.FAILED
    assert [o.state for o in outcomes] == [finished, failed, failed, finished, failed]
    assert outcomes[1].error == {"code": "RuntimeError", "detail": "out of memory"}
    assert outcomes[4].error == {"code": "weights_missing", "detail": "a long sentence"}
    assert "out of memory" in (tmp_path / "b" / "failed.json").read_text()
    assert [message for message in runs.display.messages if "failed" in message] == [
        "b failed: RuntimeError: out of memory",
        "c failed: weights_missing: a long sentence",
        "e failed: weights_missing: as c",
    ]


def test_a_grid_resumes_with_the_missing_runs(tmp_path: Path) -> None:
    plan = plain_plan("done", "begun", "failed", "new")
    Runs(tmp_path, done=0.5, failed=RuntimeError("no")).go(plain_plan("done", "failed"))
    stopped = Runs(tmp_path, begun=RunStopped())
    with pytest.raises(RunStopped):
        stopped.go(plain_plan("begun"))
    stopped.stop.is_requested = True
    with pytest.raises(RunStopped):
        stopped.go(plan)
    assert stopped.calls == ["begin begun"], "no run starts after the request"
    last = tmp_path / "begun" / "checkpoints" / "last.ckpt"
    last.parent.mkdir()
    last.write_bytes(b"")
    assert load_outcome(plan.runs[1], tmp_path).state is RunState.INTERRUPTED
    runs = Runs(tmp_path, begun=0.6, failed=0.7, new=0.8)
    outcomes = runs.go(plan)
    assert runs.calls == ["resume begun", "begin failed", "begin new"]
    assert {outcome.state for outcome in outcomes} == {RunState.FINISHED}


def test_a_finished_run_of_other_arguments_is_not_passed_off_as_this_one(tmp_path: Path) -> None:
    Runs(tmp_path, a=0.5).go(plain_plan("a"))
    other = GridPlan((PlannedRun("a", {"loss_name": "FastAPLoss"}),), {})
    with pytest.raises(Conflict, match="loss_name"):
        Runs(tmp_path).go(other)


def test_the_leaderboard_is_ranked_by_the_best_epochs_and_names_failures(tmp_path: Path) -> None:
    plan = plain_plan("low", "high", "none")
    outcomes = Runs(tmp_path, low=0.25, high=0.5, none=InvalidRequest("bad", "x")).go(plan)
    rows = leaderboard(plan, outcomes)
    assert [row["run"] for row in rows] == ["high", "low", "none"]
    assert [row["s/R1"] for row in rows] == ["50.00", "25.00", ""]
    assert rows[2]["state"] == "failed: bad"
    assert "s/R20" not in rows[0]
    write_leaderboard(rows, tmp_path)
    with (tmp_path / "leaderboard.csv").open() as file:
        assert list(csv.DictReader(file)) == rows
    assert (tmp_path / "leaderboard.md").read_text().count("\n") == 5
    outcomes[0].report["epochs"] = [{"number": 3, "figures": {}}, {"number": 7, "figures": {}}]
    assert "8" in {row.get("epochs") for row in leaderboard(plan, outcomes)}, "not validations"


@pytest.mark.parametrize(("fingerprint", "shown"), [("abc", True), ("abd", False), (None, False)])
def test_a_published_figure_stands_only_beside_one_of_the_same_set(
    fingerprint: str | None, shown: bool, tmp_path: Path
) -> None:
    planned = PlannedRun("a", {"loss_name": "NTXentLoss"}, {"s/R1": 43.25})
    plan = GridPlan((planned,), {"s": fingerprint} if fingerprint else {})
    (row,) = leaderboard(plan, Runs(tmp_path, a=0.5).go(plan))
    assert row.get("s/R1 published") == ("43.25" if shown else None)
