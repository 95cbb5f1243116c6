"""Results of an evaluation run: predictions, comparison with another run, and output files.

Predictions are an `.npy` file with (queries, k) database indices, best first, the format of the
predecessor's evaluation scripts (docs/how-to/evaluate.md). The output files of a run are the
predictions (`.npy` and `.csv`), `metrics.json`, and the pairs for hloc.
"""

from __future__ import annotations

import csv
import json
import platform
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lab.datasets.dataset import DatasetPhoto, EvaluationSet
from lab.evaluation.exact_knn import Indices, Rankings, Scores
from lab.evaluation.paired_runs import PairedDifference, paired_differences
from lab.evaluation.recall import Hits, compute_hits
from lab.evaluation.retrieval_metrics import RetrievalMetrics, hits_at_k
from shared.errors import Conflict, InvalidRequest, NotFound


def load_matrix(path: Path, kinds: str, code: str, expected: str) -> NDArray[Any]:
    """Map the matrix of an `.npy` file, with numbers of these kinds (`np.dtype.kind`).

    Raises InvalidRequest with the code `code`; the message says what is `expected`.
    """
    try:
        matrix: NDArray[Any] = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InvalidRequest(code, f"Can't read {path} as a .npy file: {error}.") from error
    if not isinstance(matrix, np.ndarray) or matrix.ndim != 2 or matrix.dtype.kind not in kinds:
        what = f"{matrix.dtype} {matrix.shape}" if isinstance(matrix, np.ndarray) else "an archive"
        raise InvalidRequest(code, f"{path} holds {what}. It must contain {expected}.")
    return matrix


def read_predictions(path: Path) -> Indices:
    """Read (queries, k) int64 database indices, best first, from an `.npy` file.

    Raises InvalidRequest: `bad_predictions` (also for a negative index), `predictions_empty`.
    """
    expected = (
        "an integer array (queries, k): for each query, the indices of the database photos, best "
        "first"
    )
    stored = load_matrix(path, "iu", "bad_predictions", expected)
    if 0 in stored.shape:
        raise InvalidRequest(
            "predictions_empty",
            f"{path} is empty: its shape is {stored.shape}. The run that wrote it failed; repeat "
            "it.",
        )
    ranked = stored.astype(np.int64)
    if ranked.min() < 0:
        raise _out_of_range(path, ranked, ranked < 0, "indices begin at 0")
    return ranked


def predictions_path(folder: Path, set_name: str) -> Path:
    """Return the path of a set's predictions, `predictions_SET.npy`."""
    return folder / f"predictions_{re.sub(r'[^A-Za-z0-9._-]+', '_', set_name)}.npy"


def check_predictions(
    path: Path, ranked: Indices, positives: Sequence[Indices], database_size: int | None
) -> None:
    """Check that predictions match the queries and the database; its size may be unknown.

    Raises InvalidRequest: `predictions_of_other_queries`, `bad_predictions`.
    """
    if len(ranked) != len(positives):
        raise InvalidRequest(
            "predictions_of_other_queries",
            f"{path} has predictions for {len(ranked)} queries, the ground truth has "
            f"{len(positives)} queries. Both must list the same queries in the same order.",
        )
    if database_size is not None and ranked.max() >= database_size:
        raise _out_of_range(
            path,
            ranked,
            ranked >= database_size,
            f"the database has {database_size} photos, and indices begin at 0",
        )


def _out_of_range(path: Path, ranked: Indices, invalid: Hits, why: str) -> InvalidRequest:
    query, rank = np.argwhere(invalid)[0]
    return InvalidRequest(
        "bad_predictions",
        f"{path} has {invalid.sum()} indices out of range, first {ranked[query, rank]} of query "
        f"{query}; {why}.",
    )


@dataclass(frozen=True, slots=True)
class RunComparison:
    """Paired comparison of this run with another one on one evaluation set."""

    other: str
    """name of the other run"""
    differences: dict[int, PairedDifference]
    """k -> recall of this run minus recall of the other"""
    won: list[int]
    """queries that are correct at rank 1 in this run only"""
    lost: list[int]
    """queries that are correct at rank 1 in the other run only"""

    def as_json(self) -> dict[str, Any]:
        return {
            "other": self.other,
            "difference": {str(k): each.as_json() for k, each in self.differences.items()},
            "won": self.won,
            "lost": self.lost,
        }


def compare_with_run(
    folder: Path, evaluation_set: EvaluationSet, measured: RetrievalMetrics
) -> RunComparison:
    """Compare this run with an earlier one, given by its `--out` folder, query by query.

    Raises as `read_comparable_run` does.
    """
    name, ranked = read_comparable_run(folder, evaluation_set)
    ks = [k for k in measured.recalls.recall_all if k <= ranked.shape[1]]
    hits = compute_hits(ranked, evaluation_set.positives)
    differences = paired_differences(
        measured.within[:, : len(ks)], hits_at_k(hits, ks), measured.clusters.labels
    )
    change = measured.hits[:, 0].astype(int) - hits[:, 0].astype(int)
    return RunComparison(
        other=name,
        differences=dict(zip(ks, differences, strict=True)),
        won=np.flatnonzero(change > 0).tolist(),
        lost=np.flatnonzero(change < 0).tolist(),
    )


def read_comparable_run(folder: Path, evaluation_set: EvaluationSet) -> tuple[str, Indices]:
    """Return the name of an earlier run, by its `--out` folder, and its predictions for the set.

    Raises:
        NotFound: `no_run`.
        InvalidRequest: `bad_run`.
        Conflict: `runs_not_comparable`, if the set, its queries or the protocol differ.
    """
    stored = _load_metrics(folder)
    set_name, positives = evaluation_set.name, evaluation_set.positives
    fingerprint = evaluation_set.fingerprint
    other_set = stored.get("sets", {}).get(set_name)
    if other_set is None:
        raise NotFound(
            "no_run",
            f"{folder} has no result for {set_name}. It has {', '.join(stored['sets'])}.",
        )
    if other_set.get("fingerprint") != fingerprint:
        raise Conflict(
            "runs_not_comparable",
            f"{set_name} in {folder} has the fingerprint {str(other_set.get('fingerprint'))[:12]}, "
            f"in this run it is {fingerprint[:12]}: the photos, the positives or the protocol "
            "differ. Evaluate both runs on the same set.",
        )
    ranked = read_predictions(predictions_path(folder, set_name))
    if len(ranked) != len(positives):
        raise InvalidRequest(
            "bad_run", f"{folder} has predictions for {len(ranked)} of {len(positives)} queries."
        )
    return str(stored.get("run", {}).get("name") or folder.name), ranked


def _load_metrics(folder: Path) -> dict[str, Any]:
    file = folder / "metrics.json"
    if not file.is_file():
        raise NotFound(
            "no_run",
            f"{folder} is not an output folder of `placewise evaluate --out`: it has no "
            f"{file.name}.",
        )
    try:
        metrics = json.loads(file.read_text())
    except ValueError as error:
        raise InvalidRequest("bad_run", f"{file} is not valid JSON: {error}.") from error
    if not isinstance(metrics, dict) or not isinstance(metrics.get("sets"), dict):
        raise InvalidRequest("bad_run", f"{file} was not written by `placewise evaluate`.")
    return metrics


@dataclass(frozen=True)
class EvaluationRun:
    """Metadata of a run, common to all of its evaluation sets."""

    name: str
    """checkpoint file, extractor, map of a server, or predictions file"""
    fingerprint: str | None
    """identifies everything that determines a descriptor's value; None if unknown"""
    about: dict[str, Any] = field(default_factory=dict)
    """more facts for the report and `metrics.json`"""


@dataclass(frozen=True)
class EvaluationResult:
    """Rankings and metrics of one evaluation set."""

    evaluation_set: EvaluationSet
    """the database is empty for a predictions file without photo lists"""
    ranked: Rankings
    has_scores: bool
    """false for a predictions file, whose `ranked.scores` are meaningless"""
    measured: RetrievalMetrics
    about: dict[str, Any]
    """`dimension`, `describe_ms_per_photo`, ... as far as known"""
    against: RunComparison | None = None
    """comparison with an earlier run"""
    places: dict[str, Any] | None = None
    """answers at the levels of places (`measure_places`)"""

    @property
    def scores(self) -> Scores | None:
        return self.ranked.scores if self.has_scores else None

    def match(self, query: int, rank: int) -> DatasetPhoto | None:
        """Return the database photo at a rank, from 0; None if the database is not listed."""
        if not self.evaluation_set.database:
            return None
        return self.evaluation_set.database[int(self.ranked.indices[query, rank])]

    def match_name(self, query: int, rank: int) -> str:
        """Return the name of the database photo at a rank, or its index if it is not listed."""
        photo = self.match(query, rank)
        return photo.name if photo else str(self.ranked.indices[query, rank])

    def as_json(self) -> dict[str, Any]:
        return {
            "fingerprint": self.evaluation_set.fingerprint,
            "protocol": self.evaluation_set.protocol,
            "rule": self.evaluation_set.rule,
            "database": len(self.evaluation_set.database) or None,
            **self.about,
            **self.measured.as_json(),
            "against": self.against.as_json() if self.against else None,
            "places": self.places,
        }


REPORTED_PACKAGES = ("numpy", "pillow", "torch", "torchvision", "timm", "faiss-cpu", "faiss-gpu")


def build_metrics(run: EvaluationRun, results: Sequence[EvaluationResult]) -> dict[str, Any]:
    """Build the content of `metrics.json`: run, package versions, metrics by set."""
    return {
        "run": {"name": run.name, "fingerprint": run.fingerprint, **run.about},
        "versions": package_versions(),
        "sets": {result.evaluation_set.name: result.as_json() for result in results},
    }


def write_run_files(out: Path, run: EvaluationRun, results: Sequence[EvaluationResult]) -> None:
    """Write `predictions_SET.npy` and `.csv` of each set, then `metrics.json`.

    `metrics.json` is written last and atomically: if it exists, all files are complete.
    """
    out.mkdir(parents=True, exist_ok=True)
    for result in results:
        predictions = predictions_path(out, result.evaluation_set.name)
        np.save(predictions, result.ranked.indices)
        _write_predictions_csv(predictions.with_suffix(".csv"), result)
    text = json.dumps(build_metrics(run, results), indent=2, ensure_ascii=False, allow_nan=False)
    partial = out / ".metrics.json.partial"
    partial.write_text(text + "\n", encoding="utf-8")
    partial.replace(out / "metrics.json")


def write_pairs(file: Path, results: Sequence[EvaluationResult]) -> None:
    """Write the retrieved pairs in hloc's format: a line `query database` per pair, by rank."""
    with file.open("w", encoding="utf-8") as lines:
        for result in results:
            for query, rank in np.ndindex(result.measured.hits.shape):
                name = result.evaluation_set.queries[query].name
                lines.write(f"{name} {result.match_name(query, rank)}\n")


def package_versions() -> dict[str, str]:
    """Return the versions of the installed packages that can influence metrics."""
    versions = {"python": platform.python_version(), "placewise": version("placewise")}
    for package in REPORTED_PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    return versions


def _write_predictions_csv(file: Path, result: EvaluationResult) -> None:
    scores, metres = result.scores, result.measured.metres
    with file.open("w", encoding="utf-8", newline="") as opened:
        table = csv.writer(opened, lineterminator="\n")
        table.writerow(["query", "rank", "match", "score", "metres", "correct"])
        for query, rank in np.ndindex(result.measured.hits.shape):
            known = metres is not None and np.isfinite(metres[query, rank])
            table.writerow(
                [
                    result.evaluation_set.queries[query].name,
                    rank + 1,
                    result.match_name(query, rank),
                    "" if scores is None else f"{scores[query, rank]:.6f}",
                    f"{metres[query, rank]:.2f}" if metres is not None and known else "",
                    "true" if result.measured.hits[query, rank] else "false",
                ]
            )
