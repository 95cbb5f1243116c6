"""One answered evaluation set, with all that its files and its report say.

Two runs on the same queries: who won which, and whether that is more than chance.

Predictions as the predecessor wrote them: (queries, k) database indices, the best first.

The files of a run: predictions, their table, figures, pairs.
"""

from __future__ import annotations

import csv
import json
import platform
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from shared.datasets.check import SuspectLabel
from shared.datasets.dataset import PublishedResult
from shared.datasets.open_dataset import DatasetPhoto, EvaluationSet
from shared.errors import Conflict, InvalidRequest, NotFound
from shared.evaluation.bootstrap import PairedDifference, paired_differences
from shared.evaluation.exact_knn import Indices, Rankings, Scores
from shared.evaluation.retrieval_metrics import RetrievalMetrics, compute_hits, hits_at_k

MAX_ENTRIES_SHOWN = 5  # wrong entries that an error names


def read_predictions(path: Path) -> Indices:
    """(queries, k) int64 from an `.npy` file.

    Raises InvalidRequest: `predictions_unreadable`, `predictions_empty`, `bad_predictions` (no
    two-dimensional array of whole numbers, or a number below 0).
    """
    try:
        found = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InvalidRequest(
            "predictions_unreadable", f"{path} can't be read as predictions in .npy: {error}."
        ) from error
    if not isinstance(found, np.ndarray) or found.ndim != 2 or found.dtype.kind not in "iu":
        what = f"{found.dtype} {found.shape}" if isinstance(found, np.ndarray) else "an archive"
        raise InvalidRequest(
            "bad_predictions",
            f"{path} holds {what}; predictions are whole numbers (queries, k): of each query, the "
            "indices of the database photos found, the best first.",
        )
    if 0 in found.shape:
        raise InvalidRequest(
            "predictions_empty",
            f"{path} has the shape {found.shape}: it says nothing about any query. The run that "
            "wrote it had failed; make it again.",
        )
    ranked = found.astype(np.int64)
    if ranked.min() < 0:
        raise _out_of_range(path, ranked, ranked < 0, "indices are counted from 0")
    return ranked


def check_predictions(
    path: Path, ranked: Indices, positives: Sequence[Indices], database_size: int | None
) -> None:
    """Whether they can be about these queries, and about a database of that many photos; None
    where nobody has said how many.

    Raises InvalidRequest: `predictions_of_other_queries`, `bad_predictions`.
    """
    if len(ranked) != len(positives):
        raise InvalidRequest(
            "predictions_of_other_queries",
            f"{path} holds predictions for {len(ranked)} queries, the ground truth is of "
            f"{len(positives)}. Both have to be of the same list, in the same order.",
        )
    if database_size is not None and ranked.max() >= database_size:
        raise _out_of_range(
            path,
            ranked,
            ranked >= database_size,
            f"the database has {database_size} photos, 0 the first",
        )


def _out_of_range(
    path: Path, ranked: Indices, wrong: np.ndarray[tuple[int, ...], np.dtype[np.bool_]], why: str
) -> InvalidRequest:
    where = np.argwhere(wrong)
    named = ", ".join(f"{ranked[q, k]} of query {q}" for q, k in where[:MAX_ENTRIES_SHOWN].tolist())
    more = f" and {len(where) - MAX_ENTRIES_SHOWN} more" if len(where) > MAX_ENTRIES_SHOWN else ""
    return InvalidRequest("bad_predictions", f"{path} is out of range: {named}{more}; {why}.")


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


@dataclass(frozen=True)
class EvaluationRun:
    """What answered, the same for all sets of a run."""

    name: str
    """a checkpoint's file, an extractor, a server's map, a predictions file"""
    fingerprint: str | None
    """of what decides a descriptor's value; None where nothing says it"""
    about: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class EvaluationResult:
    asked: EvaluationSet
    """Of a predictions file without lists, the database is empty."""
    ranked: Rankings
    has_scores: bool
    measured: RetrievalMetrics
    about: dict[str, Any]
    """`dimension`, `describe_ms_per_photo`, ... as far as they are known"""
    against: RunComparison | None = None
    published: tuple[PublishedResult, ...] = ()
    suspects: tuple[SuspectLabel, ...] = ()
    """confident first matches that the rule calls wrong and that lie just outside of it"""

    @property
    def file_name(self) -> str:
        """The set's name as a part of file names."""
        return re.sub(r"[^A-Za-z0-9._-]+", "_", self.asked.name)

    @property
    def scores(self) -> Scores | None:
        return self.ranked.scores if self.has_scores else None

    def match(self, query: int, rank: int) -> DatasetPhoto | None:
        """The database photo at that rank, from 0; None where no list names it."""
        if not self.asked.database:
            return None
        return self.asked.database[int(self.ranked.indices[query, rank])]

    def match_name(self, query: int, rank: int) -> str:
        """Its name, or else its number."""
        shot = self.match(query, rank)
        return shot.name if shot else str(self.ranked.indices[query, rank])

    def as_json(self) -> dict[str, Any]:
        return {
            "fingerprint": self.asked.fingerprint,
            "protocol": self.asked.protocol,
            "rule": self.asked.rule,
            "database": len(self.asked.database) or None,
            **self.about,
            **self.measured.as_json(),
            "against": self.against.as_json() if self.against else None,
            "published": [found.as_json() for found in self.published],
            "suspects": [asdict(suspect) for suspect in self.suspects],
        }


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
