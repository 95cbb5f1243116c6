"""Two runs on the same queries: who won which, and whether that is more than chance."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from services.trainer.evaluation.bootstrap import PairedDifference, paired_differences
from services.trainer.evaluation.hits import compute_hits, hits_at_k
from services.trainer.evaluation.measure import RetrievalMetrics
from services.trainer.evaluation.nearest import Indices
from services.trainer.evaluation.predictions import read_predictions
from shared.errors import Conflict, InvalidRequest, NotFound


@dataclass(frozen=True, slots=True)
class RunComparison:
    """This run against another one, on one evaluation set."""

    other: str
    """what the other run calls itself"""
    differences: dict[int, PairedDifference]
    """by k: this run's recall less the other's"""
    won: list[int]
    """queries that are right at rank 1 here and wrong there"""
    lost: list[int]

    def as_json(self) -> dict[str, Any]:
        return {
            "other": self.other,
            "difference": {str(k): found.as_json() for k, found in self.differences.items()},
            "won": self.won,
            "lost": self.lost,
        }


def compare_with_run(
    folder: Path,
    set_name: str,
    fingerprint: str,
    measured: RetrievalMetrics,
    positives: Sequence[Indices],
) -> RunComparison:
    """This run's figures against those of an earlier `--out` folder.

    Raises NotFound (`no_run`), InvalidRequest (`bad_run`), Conflict (`runs_not_comparable`): the
    other run asked another set, other queries, or under other rules.
    """
    about = _load_metrics(folder)
    theirs = about.get("sets", {}).get(set_name)
    if theirs is None:
        raise NotFound(
            "no_run", f"{folder} has no result of {set_name}; it has {', '.join(about['sets'])}."
        )
    if theirs.get("fingerprint") != fingerprint:
        raise Conflict(
            "runs_not_comparable",
            f"{set_name} in {folder} has the fingerprint {str(theirs.get('fingerprint'))[:12]}, "
            f"here it is {fingerprint[:12]}: other photos, positives or another protocol. Evaluate "
            "both on the same set.",
        )
    ranked = read_predictions(folder / f"predictions_{set_name}.npy")
    if len(ranked) != len(positives):
        raise InvalidRequest(
            "bad_run", f"{folder} holds predictions for {len(ranked)} of {len(positives)} queries."
        )
    ks = [k for k in measured.recalls.recall_all if k <= ranked.shape[1]]
    hits = compute_hits(ranked, positives)
    found = paired_differences(
        measured.within[:, : len(ks)], hits_at_k(hits, ks), measured.clusters.of
    )
    gained = measured.hits[:, 0].astype(int) - hits[:, 0].astype(int)
    return RunComparison(
        other=str(about.get("run", {}).get("name") or folder.name),
        differences=dict(zip(ks, found, strict=True)),
        won=np.flatnonzero(gained > 0).tolist(),
        lost=np.flatnonzero(gained < 0).tolist(),
    )


def _load_metrics(folder: Path) -> dict[str, Any]:
    file = folder / "metrics.json"
    if not file.is_file():
        raise NotFound(
            "no_run", f"{folder} is no folder of `placewise evaluate --out`: no {file.name} there."
        )
    try:
        about = json.loads(file.read_text())
    except ValueError as error:
        raise InvalidRequest("bad_run", f"{file} is no JSON: {error}.") from error
    if not isinstance(about, dict) or not isinstance(about.get("sets"), dict):
        raise InvalidRequest("bad_run", f"{file} was not written by `placewise evaluate`.")
    return about
