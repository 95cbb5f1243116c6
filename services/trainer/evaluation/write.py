"""The files of a run: predictions, their table, figures, pairs."""

from __future__ import annotations

import csv
import json
import platform
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from services.trainer.evaluation.result import EvaluationResult, EvaluationRun

REPORTED_PACKAGES = ("numpy", "pillow", "torch", "torchvision", "timm", "faiss-cpu", "faiss-gpu")


def build_metrics(run: EvaluationRun, results: Sequence[EvaluationResult]) -> dict[str, Any]:
    """Everything that was measured, and with what."""
    return {
        "run": {"name": run.name, "fingerprint": run.fingerprint, **run.about},
        "versions": package_versions(),
        "sets": {result.asked.name: result.as_json() for result in results},
    }


def write_run_files(out: Path, run: EvaluationRun, results: Sequence[EvaluationResult]) -> None:
    """`predictions_SET.npy` and `.csv` of each set, and last `metrics.json`: where that is, all
    of them are."""
    out.mkdir(parents=True, exist_ok=True)
    for result in results:
        np.save(out / f"predictions_{result.file_name}.npy", result.ranked.indices)
        _write_predictions_csv(out / f"predictions_{result.file_name}.csv", result)
    text = json.dumps(build_metrics(run, results), indent=2, ensure_ascii=False, allow_nan=False)
    partial = out / ".metrics.json.partial"
    partial.write_text(text + "\n", encoding="utf-8")
    partial.replace(out / "metrics.json")


def write_pairs(file: Path, results: Sequence[EvaluationResult]) -> int:
    """The pairs that a localisation goes on with (hloc): `query database` by name, a line each, in
    the order of the ranking; returns how many."""
    count = 0
    with file.open("w", encoding="utf-8") as lines:
        for result in results:
            for query, shot in enumerate(result.asked.queries):
                for rank in range(result.measured.depth):
                    lines.write(f"{shot.name} {result.match_name(query, rank)}\n")
                    count += 1
    return count


def package_versions() -> dict[str, str]:
    """Of what a figure may depend on, as far as it is installed."""
    found = {"python": platform.python_version(), "placewise": version("placewise")}
    for package in REPORTED_PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found


def _write_predictions_csv(file: Path, result: EvaluationResult) -> None:
    scores, metres = result.scores, result.measured.metres
    with file.open("w", encoding="utf-8", newline="") as opened:
        table = csv.writer(opened, lineterminator="\n")
        table.writerow(["query", "rank", "match", "score", "metres", "correct"])
        for query, shot in enumerate(result.asked.queries):
            for rank in range(result.measured.depth):
                away = None if metres is None else float(metres[query, rank])
                table.writerow(
                    [
                        shot.name,
                        rank + 1,
                        result.match_name(query, rank),
                        "" if scores is None else f"{scores[query, rank]:.6f}",
                        "" if away is None or np.isnan(away) else f"{away:.2f}",
                        "true" if result.measured.hits[query, rank] else "false",
                    ]
                )
