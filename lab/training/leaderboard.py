"""Leaderboard of a grid's runs, as rows, CSV and Markdown.

A published result is shown only if the evaluation set has the fingerprint of the published one.
Otherwise the two results are not comparable.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lab.training.grid import GridPlan, RunOutcome, RunState

SETTING_COLUMNS = ("agg_arch", "loss_name", "miner_name")
SHOWN_KS = (1, 5)

Row = dict[str, str]


def leaderboard(plan: GridPlan, outcomes: Sequence[RunOutcome]) -> list[Row]:
    """Build a row per run, best first by the monitored metric; runs without metrics come last."""
    ranked = sorted(outcomes, key=lambda outcome: -_score(outcome))
    comparable = _comparable_sets(plan, outcomes)
    rows = [_row(outcome, comparable) for outcome in ranked]
    columns = dict.fromkeys(column for row in rows for column in row)
    return [{column: row.get(column, "") for column in columns} for row in rows]


def write_leaderboard(rows: Sequence[Row], out: Path) -> None:
    """Write `leaderboard.csv` and `leaderboard.md` to a folder."""
    columns = list(rows[0])
    with (out / "leaderboard.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    lines = [columns, ["---"] * len(columns), *([row[name] for name in columns] for row in rows)]
    text = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    (out / "leaderboard.md").write_text(f"{text}\n", encoding="utf-8")


def _row(outcome: RunOutcome, comparable: set[str]) -> Row:
    row: Row = {"run": outcome.run.name}
    if outcome.report is None:
        row |= {name: str(outcome.run.arguments.get(name, "")) for name in SETTING_COLUMNS}
        code = f": {outcome.error['code']}" if outcome.error else ""
        return {**row, "state": f"{outcome.state}{code}"}
    report = outcome.report
    row |= {name: str(report["arguments"][name]) for name in SETTING_COLUMNS}
    row["state"] = str(outcome.state)
    metrics = {**best_epoch(report)["figures"], **_test_metrics(report)}
    for metric, value in metrics.items():
        set_name, _, recall_name = metric.rpartition("/")
        if int(recall_name.removeprefix("R")) not in SHOWN_KS:
            continue
        row[metric] = f"{value:.2%}".removesuffix("%")
        if metric in outcome.run.published and set_name in comparable:
            row[f"{metric} published"] = f"{outcome.run.published[metric]:.2f}"
    row["dimension"] = str(report["best"]["dimension"])
    row["epochs"] = str(report["epochs"][-1]["number"] + 1 if report["epochs"] else 0)
    row["photos/s"] = f"{report['images_per_second'] or 0:.1f}"
    row["checkpoint"] = Path(report["best"]["path"]).name
    return row


def _comparable_sets(plan: GridPlan, outcomes: Sequence[RunOutcome]) -> set[str]:
    comparable = set()
    for outcome in outcomes:
        for name, metadata in (outcome.report or {}).get("sets", {}).items():
            if plan.fingerprints.get(name) == metadata["fingerprint"]:
                comparable.add(name)
    return comparable


def best_epoch(report: dict[str, Any]) -> dict[str, Any]:
    """Return the epoch of `metrics.json` with the best monitored metric."""
    monitor, sign = report["monitor"], 1 if report["arguments"]["mode"] == "max" else -1
    empty: dict[str, Any] = {"figures": {}}
    return max(
        report["epochs"], key=lambda each: sign * each["figures"].get(monitor, 0.0), default=empty
    )


def _test_metrics(report: dict[str, Any]) -> dict[str, float]:
    """Return test metrics, which take precedence over validation metrics of the same set."""
    return {
        f"{name}/R{k}": recall
        for name, result in report["test"].items()
        for k, recall in result["recall"].items()
        if recall is not None
    }


def _score(outcome: RunOutcome) -> float:
    if outcome.state is not RunState.FINISHED or outcome.report is None:
        return float("-inf")
    value = best_epoch(outcome.report)["figures"].get(outcome.report["monitor"])
    if value is None:
        return float("-inf")
    return float(value) if outcome.report["arguments"]["mode"] == "max" else -float(value)
