"""What `placewise evaluate` writes and prints of its results.

`placewise evaluate --predictions P.npy --ground-truth GT.npy`: what was found before, judged.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.table import Column, Table

from services.cli.evaluation.commands import ReportOptions
from services.cli.output import console, print_json, printable_path
from shared.datasets.check import find_suspect_labels
from shared.datasets.dataset import find_published_results
from shared.datasets.ground_truth_files import read_ground_truth, read_integer_lists
from shared.datasets.open_dataset import DatasetPhoto, EvaluationSet
from shared.datasets.photo_lists import read_photo_list
from shared.errors import InvalidRequest, Misconfigured
from shared.evaluation.bootstrap import ConfidenceInterval, cluster_queries, singleton_clusters
from shared.evaluation.exact_knn import Rankings
from shared.evaluation.ranking import DEFAULT_KS
from shared.evaluation.report.page import render_report
from shared.evaluation.results import (
    EvaluationResult,
    EvaluationRun,
    build_metrics,
    check_predictions,
    compare_with_run,
    read_predictions,
    write_pairs,
    write_run_files,
)
from shared.evaluation.retrieval_metrics import compute_metrics, match_distances


def check_output_folders(options: ReportOptions) -> None:
    """Before the minutes that describing takes: whether results can be written where they are
    wanted; Misconfigured (`out_unwritable`)."""
    try:
        if options.out is not None:
            options.out.mkdir(parents=True, exist_ok=True)
        if options.pairs is not None:
            options.pairs.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _unwritable_error(options.out or options.pairs, error) from error


def evaluate_rankings(
    evaluation_set: EvaluationSet,
    ranked: Rankings,
    options: ReportOptions,
    *,
    has_scores: bool,
    about: dict[str, object],
) -> EvaluationResult:
    """All figures of one set, and those against an earlier run."""
    measured = compute_metrics(
        ranked.indices,
        evaluation_set.positives,
        cluster_queries(evaluation_set.queries)
        if evaluation_set.database
        else singleton_clusters(len(evaluation_set.queries)),
        scores=ranked.scores if has_scores else None,
        metres=(
            match_distances(evaluation_set.queries, evaluation_set.database, ranked.indices)
            if evaluation_set.database
            else None
        ),
        ks=DEFAULT_KS,
    )
    against = None
    if options.against is not None:
        against = compare_with_run(
            options.against,
            evaluation_set.name,
            evaluation_set.fingerprint,
            measured,
            evaluation_set.positives,
        )
    return EvaluationResult(
        evaluation_set,
        ranked,
        has_scores,
        measured,
        about,
        against=against,
        published=find_published_results(evaluation_set),
        suspects=(
            tuple(
                find_suspect_labels(
                    evaluation_set, ranked.indices, ranked.scores if has_scores else None
                )
            )
            if evaluation_set.database
            else ()
        ),
    )


def output_results(
    run: EvaluationRun, results: Sequence[EvaluationResult], options: ReportOptions
) -> None:
    """Write what is wanted, print the figures."""
    try:
        if options.out is not None:
            write_run_files(options.out, run, results)
            report = render_report(
                run, results, grids_shown=options.grids, only_wrong=options.only_wrong
            )
            (options.out / "report.html").write_text(report, encoding="utf-8")
        if options.pairs is not None:
            write_pairs(options.pairs, results)
    except OSError as error:
        raise _unwritable_error(options.out or options.pairs, error) from error
    if options.as_json:
        found = build_metrics(run, results)
        if len(results) == 1:  # a program that asks about one set need not know its name
            found |= found["sets"][results[0].evaluation_set.name]
        print_json(found)
        return
    for result in results:
        _print_result(result)
    if options.out is not None:
        console.print(
            f"{printable_path(options.out / 'report.html')}", soft_wrap=True, markup=False
        )


def _print_result(result: EvaluationResult) -> None:
    evaluation_set, measured = result.evaluation_set, result.measured
    recalls = measured.recalls
    table = Table(
        evaluation_set.name,
        Column(f"all {recalls.queries} queries", justify="right"),
        Column(f"{recalls.queries - recalls.without_positive} with a positive", justify="right"),
    )
    for at, (k, share) in enumerate(recalls.recall_all.items()):
        table.add_row(
            f"R@{k}",
            _format_share(share, measured.recall_intervals, at),
            _format_share(recalls.recall_findable[k], measured.findable_intervals, at),
        )
    mean, within = measured.mean_average_precision, measured.map_interval
    table.add_row(f"mAP@{measured.depth}", "", _format_share(mean, [within] if within else None, 0))
    console.print(table)
    console.print(
        f"Right: {evaluation_set.rule}; protocol {evaluation_set.protocol}; "
        f"fingerprint {evaluation_set.fingerprint[:16]}; "
        + (
            f"95 % intervals over {measured.clusters.count} {measured.clusters.kind}."
            if measured.recall_intervals
            else f"{measured.clusters.count} {measured.clusters.kind} are too few for intervals."
        ),
        soft_wrap=True,
        markup=False,
    )
    if result.against is not None:
        for k, found in result.against.differences.items():
            interval = (
                f" ({100 * found.low:+.1f} to {100 * found.high:+.1f})"
                if found.low is not None and found.high is not None
                else ""
            )
            console.print(
                f"R@{k} {100 * found.mean:+.1f} points{interval} against {result.against.other}: "
                f"{found.won} won, {found.lost} lost.",
                soft_wrap=True,
                markup=False,
            )


def _format_share(
    share: float, intervals: Sequence[ConfidenceInterval] | None, position: int
) -> str:
    if math.isnan(share):  # no query to take it of
        return "-"
    if intervals is None:
        return f"{100 * share:.1f} %"
    return (
        f"{100 * share:.1f} % ({100 * intervals[position].low:.1f} to "
        f"{100 * intervals[position].high:.1f})"
    )


def _unwritable_error(path: Path | None, error: OSError) -> Misconfigured:
    return Misconfigured("out_unwritable", f"{path} can't be written: {error.strerror}.")


PREDICTIONS_PROTOCOL = "predictions file"


def evaluate_predictions(
    predictions: Path,
    ground_truth: Path,
    database: Path | None,
    queries: Path | None,
    photos: Path | None,
    sets: Sequence[str] | None,
    options: ReportOptions,
) -> None:
    """`photos` is the folder in which the lists' names are looked for; left out: that of the lists.

    Raises InvalidRequest: `one_list`, `which_set`, and what reading the files raises.
    """
    if (database is None) != (queries is None):
        raise InvalidRequest("one_list", "Give both lists, --database and --queries, or none.")
    if sets and len(sets) > 1:
        raise InvalidRequest("which_set", "A predictions file is of one set: give --set once.")
    check_output_folders(options)
    ranked = read_predictions(predictions)
    name = sets[0] if sets else ground_truth.stem
    rule = None
    shots: tuple[tuple[DatasetPhoto, ...], tuple[DatasetPhoto, ...]]
    if database is not None and queries is not None:
        shots = read_photo_list(database, photos), read_photo_list(queries, photos)
        there, asked_for = ([shot.name for shot in role] for role in shots)
        positives, rule = read_ground_truth(ground_truth, database=there, queries=asked_for)
        check_predictions(predictions, ranked, positives, len(there))
    else:
        positives = read_integer_lists(ground_truth)
        check_predictions(predictions, ranked, positives, None)
        # Nothing is known of them but their numbers.
        numbered = tuple(
            DatasetPhoto(Path(f"query {q}"), f"query {q}") for q in range(len(positives))
        )
        shots = (), numbered
    asked = EvaluationSet(
        name=name,
        root=photos or predictions.parent,
        database=shots[0],
        queries=shots[1],
        positives=tuple(positives),
        rule=rule or f"given by {ground_truth.name}",
        protocol=PREDICTIONS_PROTOCOL,
    )
    kept = ranked[:, : options.depth]
    found = Rankings(kept, np.zeros(kept.shape, np.float32))
    result = evaluate_rankings(asked, found, options, has_scores=False, about={})
    run = EvaluationRun(predictions.stem, None, {"predictions": predictions.name})
    output_results(run, [result], options)
