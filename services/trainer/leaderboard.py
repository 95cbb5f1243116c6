"""The runs of a grid side by side: as rows, CSV and markdown.

A published figure stands beside one's own only where the set's fingerprint is that of the published
one: else the two are figures of different things.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from services.trainer.grid import GridPlan, RunOutcome, RunState

SETTING_COLUMNS = ("agg_arch", "loss_name", "miner_name")
SHOWN_KS = (1, 5)

Row = dict[str, str]


def leaderboard(plan: GridPlan, outcomes: Sequence[RunOutcome]) -> list[Row]:
    """One row for each run, the best first by its own metric; those without figures come last."""
    ranked = sorted(outcomes, key=lambda outcome: -_score(outcome))
    comparable = _comparable_sets(plan, outcomes)
    rows = [_row(outcome, comparable) for outcome in ranked]
    columns = dict.fromkeys(column for row in rows for column in row)
    return [{column: row.get(column, "") for column in columns} for row in rows]


def write_leaderboard(rows: Sequence[Row], out: Path) -> None:
    """`leaderboard.csv` and `leaderboard.md` in the folder."""
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
        why = f": {outcome.error['code']}" if outcome.error else ""
        return {**row, "state": f"{outcome.state}{why}"}
    report = outcome.report
    row |= {name: str(report["arguments"][name]) for name in SETTING_COLUMNS}
    row["state"] = str(outcome.state)
    figures = {**_best_epoch(report)["figures"], **_test_metrics(report)}
    for metric, share in figures.items():
        set_name, _, at = metric.rpartition("/")
        if int(at.removeprefix("R")) not in SHOWN_KS:
            continue
        row[metric] = f"{share:.2%}".removesuffix("%")
        if metric in outcome.run.published and set_name in comparable:
            row[f"{metric} published"] = f"{outcome.run.published[metric]:.2f}"
    row["dimension"] = str(report["best"]["dimension"])
    row["epochs"] = str(len(report["epochs"]))
    row["photos/s"] = f"{report['images_per_second'] or 0:.1f}"
    row["checkpoint"] = Path(report["best"]["path"]).name
    return row


def _comparable_sets(plan: GridPlan, outcomes: Sequence[RunOutcome]) -> set[str]:
    found = set()
    for outcome in outcomes:
        for name, about in (outcome.report or {}).get("sets", {}).items():
            if plan.fingerprints.get(name) == about["fingerprint"]:
                found.add(name)
    return found


def _best_epoch(report: dict[str, Any]) -> dict[str, Any]:
    monitor, sign = report["monitor"], 1 if report["arguments"]["mode"] == "max" else -1
    empty: dict[str, Any] = {"figures": {}}
    return max(
        report["epochs"], key=lambda each: sign * each["figures"].get(monitor, 0.0), default=empty
    )


def _test_metrics(report: dict[str, Any]) -> dict[str, float]:
    """A test's figures; they stand above a validation's of the same set."""
    return {
        f"{name}/R{k}": share
        for name, one in report["test"].items()
        for k, share in one["recall"].items()
        if share is not None
    }


def _score(outcome: RunOutcome) -> float:
    if outcome.state is not RunState.FINISHED or outcome.report is None:
        return float("-inf")
    figure = _best_epoch(outcome.report)["figures"].get(outcome.report["monitor"])
    if figure is None:
        return float("-inf")
    return float(figure) if outcome.report["arguments"]["mode"] == "max" else -float(figure)
