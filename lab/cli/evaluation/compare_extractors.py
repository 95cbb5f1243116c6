"""Comparison of several extractors on one data set: recall, time and size. Imports torch.

An entry may reduce its descriptors by PCA whitening, which is fitted on the database rows only.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import Progress
from rich.table import Column

from lab.cli.evaluation.describers import checkpoint_describer, extractor_describer
from lab.cli.evaluation.results import check_output_folders
from lab.datasets.dataset import EvaluationSet
from lab.datasets.open_dataset import open_evaluation_set
from lab.evaluation.exact_knn import exact_knn
from lab.evaluation.paired_runs import PairedDifference, paired_differences
from lab.evaluation.query_clusters import cluster_queries
from lab.evaluation.ranking import DEFAULT_KS, Rows, describe_evaluation_set
from lab.evaluation.report.tables import write_table
from lab.evaluation.results import package_versions
from lab.evaluation.retrieval_metrics import RetrievalMetrics, compute_metrics
from services.cli.environment import read_settings
from services.cli.output import (
    Table,
    print_json,
    print_message,
    print_table,
    progress_bar,
    refuse_unwritable,
    stage_bars,
)
from shared.config.settings import Settings
from shared.descriptors.extractor import choose_device
from shared.descriptors.inference import inference_clock
from shared.descriptors.pca_fit import check_pca_fittable, fit_pca_stream, sample_rows, sample_size
from shared.descriptors.pca_whitening import PcaProjection
from shared.errors import InvalidRequest
from shared.extractor_config.configs import MAX_PCA_DIMENSION, get_extractor_config

BLOCK_BYTES = 64_000_000
SEED = 0
CHECKPOINT_SUFFIXES = (".ckpt", ".pth")


def whiten_set(
    database: Rows,
    queries: Rows,
    components: int,
    device: str,
    on_progress: Callable[[str, int, int], None] = lambda stage, done, total: None,
) -> tuple[Rows, Rows, float]:
    """Fit a PCA whitening on the (m, D) database rows, and project them and the (n, D) query rows.

    Returns (m, components) and (n, components) rows, and the milliseconds to project one row.
    Raises Unprocessable: `pca_too_few_rows`, `pca_too_many_dimensions`.
    """
    dimension = database.shape[1]
    check_pca_fittable(len(database), dimension, components)
    sampled = sample_rows(len(database), sample_size(dimension, components), SEED)
    block_rows = max(1, BLOCK_BYTES // (4 * dimension))
    batches = (database[sampled[b : b + block_rows]] for b in range(0, len(sampled), block_rows))
    whitening = fit_pca_stream(batches, len(sampled), dimension, components, on_progress)
    chosen = choose_device(device)
    projection, clock = PcaProjection(whitening, chosen), inference_clock(chosen)
    started = clock()
    reduced = [_project(rows, projection, block_rows) for rows in (database, queries)]
    seconds = clock() - started
    return reduced[0], reduced[1], 1000 * seconds / max(1, len(database) + len(queries))


def _project(rows: Rows, projection: PcaProjection, block_rows: int) -> Rows:
    reduced = np.empty((len(rows), projection.components), np.float32)
    for begin in range(0, len(rows), block_rows):
        block = slice(begin, begin + block_rows)
        reduced[block] = projection.project(np.array(rows[block]))
    return reduced


PCA_SUFFIX = re.compile(r"pca([1-9][0-9]{0,4})")


@dataclass(frozen=True, slots=True)
class ComparisonEntry:
    """One extractor of a comparison."""

    spec_text: str
    name: str
    """An extractor name with options, or the path of a checkpoint."""
    fit: bool = False
    pca: int | None = None


def parse_entries(text: str) -> list[ComparisonEntry]:
    """Parse `--extractors`: `a,b:layer=9,facet=key+pca512,run.ckpt` gives three entries.

    Raises InvalidRequest: `bad_extractors`.
    """
    parts: list[str] = []
    for part in text.split(","):
        # A comma also separates the options of one extractor.
        first = part.partition("+")[0]
        if parts and "=" in first and ":" in parts[-1] and ":" not in first:
            parts[-1] += "," + part
        else:
            parts.append(part.strip())
    return [_parse_entry(part) for part in parts]


def _parse_entry(spec_text: str) -> ComparisonEntry:
    name, fit, pca = spec_text, False, None
    while (found := name.rpartition("+"))[1]:
        name, _, addition = found
        match = PCA_SUFFIX.fullmatch(addition)
        if addition == "fit":
            fit = True
        elif match and int(match[1]) <= MAX_PCA_DIMENSION:
            pca = int(match[1])
        else:
            raise InvalidRequest(
                "bad_extractors",
                f"{spec_text}: unknown suffix +{addition}. Use +fit, or +pcaN for N dimensions, "
                f"up to {MAX_PCA_DIMENSION}.",
            )
    if not name:
        raise InvalidRequest(
            "bad_extractors", f"--extractors: {spec_text!r} has no extractor name."
        )
    return ComparisonEntry(spec_text, name, fit, pca)


@dataclass(frozen=True, slots=True)
class ComparedExtractor:
    """Metrics and costs of one extractor of a comparison."""

    name: str
    measured: RetrievalMetrics
    difference: PairedDifference | None
    """R@1 of this extractor minus R@1 of the first; None for the first"""
    dimension: int
    bytes_a_photo: int
    milliseconds_a_photo: float | None
    """None if not measured"""
    fingerprint: str
    device: str

    def against_first(self) -> str:
        """Format the difference from the first extractor in percentage points, with interval."""
        if self.difference is None:
            return ""
        mean = f"{100 * self.difference.mean:+.1f}"
        interval = self.difference.interval_in_points()
        return mean if interval is None else f"{mean} ({interval})"

    def table_cells(self) -> list[str]:
        """Format recalls, interval of R@1, time, size and difference for a table."""
        interval = self.measured.recall_intervals
        milliseconds = self.milliseconds_a_photo
        return [
            *(f"{100 * recall:.1f}" for recall in self.measured.recalls.recall_all.values()),
            interval[0].as_percent() if interval else "-",
            "-" if milliseconds is None else f"{milliseconds:.1f}",
            f"{self.bytes_a_photo:,}",
            self.against_first(),
        ]

    def as_json(self) -> dict[str, Any]:
        metrics = self.measured.as_json()
        names = ("recall", "recall_interval", "recall_findable", "mean_average_precision")
        return {
            "extractor": self.name,
            "fingerprint": self.fingerprint,
            "device": self.device,
            "dimension": self.dimension,
            "bytes_a_photo": self.bytes_a_photo,
            "milliseconds_a_photo": self.milliseconds_a_photo,
            **{name: metrics[name] for name in (*names, "intervals")},
            "against_first": self.difference.as_json() if self.difference else None,
        }


def compare_extractors(
    data: Path,
    extractors: str,
    *,
    set_name: str | None,
    protocol: str | None,
    rule: str | None,
    out: Path | None,
    faiss_gpu: bool,
    as_json: bool,
) -> None:
    """Evaluate each extractor on a data set, then write and print the comparison.

    Raises InvalidRequest (`bad_extractors`), Misconfigured (`out_unwritable`), Unprocessable (a
    photo can't be described), and errors of opening the data set and loading the extractors.
    """
    entries = parse_entries(extractors)
    settings = read_settings()
    _validate_entries(entries, settings)
    check_output_folders(out)
    evaluation_set = open_evaluation_set(data, set_name, protocol=protocol, rule=rule)
    clusters = cluster_queries(evaluation_set.queries)
    compared: list[ComparedExtractor] = []
    with progress_bar() as progress:
        for entry in entries:
            properties, measured = _evaluate_entry(
                entry, evaluation_set, settings, faiss_gpu, progress
            )
            difference: PairedDifference | None = None
            if compared:
                first = compared[0].measured
                (difference,) = paired_differences(
                    measured.within[:, :1], first.within[:, :1], clusters.labels
                )
            compared.append(ComparedExtractor(entry.spec_text, measured, difference, **properties))
    if out is not None:
        with refuse_unwritable(out):
            write_table(out, [(each.name, each.measured) for each in compared])
    if as_json:
        print_json(_comparison_as_json(evaluation_set, compared))
    else:
        _print_comparison(evaluation_set, compared)


def _validate_entries(entries: Sequence[ComparisonEntry], settings: Settings) -> None:
    """Check all entries before the first evaluation, which may take hours."""
    for entry in entries:
        if entry.name.endswith(CHECKPOINT_SUFFIXES):
            if not Path(entry.name).is_file():
                raise InvalidRequest("bad_extractors", f"Checkpoint {entry.name} does not exist.")
            if entry.fit:
                raise InvalidRequest(
                    "bad_extractors", f"{entry.spec_text}: a checkpoint uses no vocabulary."
                )
            continue
        config = get_extractor_config(
            entry.name, allow_test_extractors=settings.allow_test_extractors
        )
        if entry.fit and not config.needs_vocabulary:
            raise InvalidRequest(
                "bad_extractors", f"{entry.spec_text}: {config.name} uses no vocabulary."
            )


def _evaluate_entry(
    entry: ComparisonEntry,
    evaluation_set: EvaluationSet,
    settings: Settings,
    faiss_gpu: bool,
    progress: Progress,
) -> tuple[dict[str, Any], RetrievalMetrics]:
    describer = (
        checkpoint_describer(Path(entry.name), "same", settings)
        if entry.name.endswith(CHECKPOINT_SUFFIXES)
        else extractor_describer(
            entry.name, None, evaluation_set, settings, progress, fit=entry.fit
        )
    )
    on_progress = stage_bars(progress, f"{entry.spec_text}: ")
    describer.describe.on_lookup = partial(on_progress, "cached descriptors")
    with describe_evaluation_set(describer.describe, evaluation_set, on_progress) as rows:
        database, queries = rows
        milliseconds = describer.describe.milliseconds_a_photo()
        if entry.pca is not None:
            database, queries, projection_ms = whiten_set(
                database, queries, entry.pca, settings.device, on_progress
            )
            if milliseconds is not None:
                milliseconds += projection_ms
        search = partial(on_progress, "search")
        depth = max(DEFAULT_KS)
        ranked = exact_knn(queries, database, depth, faiss_gpu=faiss_gpu, on_progress=search)
        dimension = database.shape[1]
    measured = compute_metrics(
        ranked.indices,
        evaluation_set.positives,
        cluster_queries(evaluation_set.queries),
        scores=ranked.scores,
    )
    return {
        "dimension": dimension,
        "bytes_a_photo": settings.stored_bytes(dimension),
        "milliseconds_a_photo": milliseconds,
        "fingerprint": describer.fingerprint,
        "device": str(describer.about.get("device", "")),
    }, measured


def _comparison_as_json(
    evaluation_set: EvaluationSet, compared: Sequence[ComparedExtractor]
) -> dict[str, Any]:
    return {
        "set": evaluation_set.name,
        "protocol": evaluation_set.protocol,
        "rule": evaluation_set.rule,
        "fingerprint": evaluation_set.fingerprint,
        "versions": package_versions(),
        "extractors": [result.as_json() for result in compared],
    }


def _print_comparison(evaluation_set: EvaluationSet, compared: Sequence[ComparedExtractor]) -> None:
    ks = list(compared[0].measured.recalls.recall_all)
    columns = (*(f"R@{k}" for k in ks), "R@1 95 % CI", "CPU ms", "bytes", "vs. first")
    table = Table(
        evaluation_set.name, *(Column(name, justify="right", no_wrap=True) for name in columns)
    )
    for result in compared:
        table.add_row(result.name, *result.table_cells())
    print_table(table)
    clusters = compared[0].measured.clusters
    print_message(
        f"Positive-match criterion: {evaluation_set.rule}; protocol {evaluation_set.protocol}; "
        f"fingerprint {evaluation_set.fingerprint[:16]}; confidence intervals over "
        f"{clusters.count} {clusters.kind}. CPU ms: CPU time of inference and aggregation for a "
        "photo (on a GPU: time), measured when its descriptor was computed. bytes: that of a map."
    )
