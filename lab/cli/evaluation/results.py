"""Output of `placewise evaluate`: metrics, reports and tables.

Also implements `placewise evaluate --predictions P.npy --ground-truth GT.npy`, which evaluates
rankings that were computed elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.table import Column

from lab.cli.evaluation.commands import ReportOptions
from lab.datasets.check import find_suspect_labels
from lab.datasets.dataset import DatasetPhoto, EvaluationSet
from lab.datasets.ground_truth_files import read_ground_truth, read_integer_lists
from lab.datasets.open_dataset import open_evaluation_set
from lab.datasets.photo_lists import read_photo_list
from lab.evaluation.exact_knn import Indices, Rankings
from lab.evaluation.query_clusters import cluster_queries, singleton_clusters
from lab.evaluation.ranking import DEFAULT_KS
from lab.evaluation.report.page import render_report
from lab.evaluation.results import (
    EvaluationResult,
    EvaluationRun,
    build_metrics,
    check_predictions,
    compare_with_run,
    read_predictions,
    write_pairs,
    write_run_files,
)
from lab.evaluation.retrieval_metrics import compute_metrics, match_distances
from services.cli.evaluate import answers_table
from services.cli.output import (
    Json,
    Table,
    format_percent,
    print_json,
    print_message,
    print_table,
    printable_path,
    refuse_unwritable,
)
from shared.errors import InvalidRequest
from shared.evaluation.bootstrap import ConfidenceInterval


def check_output_folders(options: ReportOptions) -> None:
    """Create the output folders before the long computation of results.

    Raises:
        Misconfigured: `out_unwritable`.
    """
    if options.out is not None:
        with refuse_unwritable(options.out):
            options.out.mkdir(parents=True, exist_ok=True)
    if options.pairs is not None:
        with refuse_unwritable(options.pairs):
            options.pairs.parent.mkdir(parents=True, exist_ok=True)


def evaluate_rankings(
    evaluation_set: EvaluationSet,
    ranked: Rankings,
    options: ReportOptions,
    *,
    has_scores: bool,
    about: dict[str, object],
    places: Json | None = None,
) -> EvaluationResult:
    """Compute all metrics of one set, and the comparison with an earlier run, if requested.

    Args:
        evaluation_set: The set. `database` is empty if its photos are unknown; each query is then
            a cluster of its own, and no distances are reported.
        ranked: Database indices and scores per query, best first.
        options: Output options.
        has_scores: Whether the scores of `ranked` are meaningful.
        about: Further figures to report, such as the descriptor dimension.
        places: Answers at the levels of places (`measure_places`), if they were measured.
    """
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
        ks=options.ks or DEFAULT_KS,
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
        suspects=(
            tuple(
                find_suspect_labels(
                    evaluation_set, ranked.indices, ranked.scores if has_scores else None
                )
            )
            if evaluation_set.database
            else ()
        ),
        places=places,
    )


def output_results(
    run: EvaluationRun, results: Sequence[EvaluationResult], options: ReportOptions
) -> None:
    """Write the requested files and print the metrics.

    Raises:
        Misconfigured: `out_unwritable`.
    """
    if options.out is not None:
        with refuse_unwritable(options.out):
            write_run_files(options.out, run, results)
            report = render_report(
                run, results, grids_shown=options.grids, only_wrong=options.only_wrong
            )
            (options.out / "report.html").write_text(report, encoding="utf-8")
    if options.pairs is not None:
        with refuse_unwritable(options.pairs):
            write_pairs(options.pairs, results)
    if options.as_json:
        metrics = build_metrics(run, results)
        if len(results) == 1:  # also at the top level, so that scripts need not know the name
            metrics |= metrics["sets"][results[0].evaluation_set.name]
        print_json(metrics)
        return
    for result in results:
        _print_result(result)
    if options.out is not None:
        print_message(f"{printable_path(options.out / 'report.html')}")


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
    mean, interval = measured.mean_average_precision, measured.map_interval
    table.add_row(
        f"mAP@{measured.depth}", "", _format_share(mean, [interval] if interval else None, 0)
    )
    print_table(table)
    print_message(
        f"Positive-match criterion: {evaluation_set.rule}; protocol {evaluation_set.protocol}; "
        f"fingerprint {evaluation_set.fingerprint[:16]}; "
        + (
            f"95 % confidence intervals over {measured.clusters.count} {measured.clusters.kind}."
            if measured.recall_intervals
            else f"{measured.clusters.count} {measured.clusters.kind} are too few for confidence "
            "intervals."
        )
    )
    if result.places is not None:
        print_table(answers_table(result.places))
    if result.against is not None:
        for k, difference in result.against.differences.items():
            bounds = difference.interval_in_points()
            print_message(
                f"R@{k} {100 * difference.mean:+.1f} points{f' ({bounds})' if bounds else ''} "
                f"compared with "
                f"{result.against.other}: {difference.won} queries gained, "
                f"{difference.lost} lost."
            )


def _format_share(
    share: float, intervals: Sequence[ConfidenceInterval] | None, position: int
) -> str:
    if math.isnan(share):  # no query to average over
        return "-"
    if intervals is None:
        return format_percent(share)
    return f"{format_percent(share)} ({intervals[position].as_percent()})"


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
    """Evaluate a file of predictions against a ground truth file.

    Args:
        predictions: (queries, k) database indices, best first, `.npy`.
        ground_truth: The positives of each query, `.npy`.
        database: List of the database photos' names, or None.
        queries: List of the queries' names, or None.
        photos: Root folder of the names; None for the folder of each list.
        sets: At most one name, for the report.
        options: Output options.

    Raises:
        InvalidRequest: `one_list`, `which_set`, and errors of reading the files.
        Misconfigured: `out_unwritable`.
    """
    if (database is None) != (queries is None):
        raise InvalidRequest("one_list", "--database and --queries must be given together.")
    check_output_folders(options)
    ranked = read_predictions(predictions)
    name = _only_set(sets) or ground_truth.stem
    rule = f"given by {ground_truth.name}"
    photo_lists: tuple[tuple[DatasetPhoto, ...], tuple[DatasetPhoto, ...]]
    if database is not None and queries is not None:
        photo_lists = read_photo_list(database, photos), read_photo_list(queries, photos)
        database_names, query_names = ([photo.name for photo in role] for role in photo_lists)
        positives, rule = read_ground_truth(
            ground_truth, database=database_names, queries=query_names
        )
        check_predictions(predictions, ranked, positives, len(database_names))
    else:
        positives = read_integer_lists(ground_truth)
        check_predictions(predictions, ranked, positives, None)
        # Without lists, queries are identified by their numbers.
        numbered = tuple(
            DatasetPhoto(Path(f"query {q}"), f"query {q}") for q in range(len(positives))
        )
        photo_lists = (), numbered
    evaluation_set = EvaluationSet(
        name=name,
        root=photos or predictions.parent,
        database=photo_lists[0],
        queries=photo_lists[1],
        positives=tuple(positives),
        rule=rule,
        protocol=PREDICTIONS_PROTOCOL,
    )
    _output_predictions(predictions, ranked, evaluation_set, options)


def evaluate_predictions_of_set(
    predictions: Path,
    data: Path,
    sets: Sequence[str] | None,
    protocol: str | None,
    rule: str | None,
    options: ReportOptions,
) -> None:
    """Evaluate a file of predictions on a set of a data set, with the set's own ground truth.

    Args:
        predictions: (queries, k) database indices, best first, `.npy`, in the order of the set.
        data: Folder of the data set.
        sets: At most one name; may be omitted if there is only one set.
        protocol: One of the layout's protocols, or None.
        rule: Positive-match criterion, or None.
        options: Output options.

    Raises:
        InvalidRequest: `which_set`, and errors of opening the set and reading the predictions.
        Misconfigured: `out_unwritable`.
    """
    evaluation_set = open_evaluation_set(data, _only_set(sets), protocol=protocol, rule=rule)
    check_output_folders(options)
    ranked = read_predictions(predictions)
    check_predictions(predictions, ranked, evaluation_set.positives, len(evaluation_set.database))
    _output_predictions(predictions, ranked, evaluation_set, options)


def _only_set(sets: Sequence[str] | None) -> str | None:
    if sets and len(sets) > 1:
        raise InvalidRequest("which_set", "A predictions file belongs to one set. Pass --set once.")
    return sets[0] if sets else None


def _output_predictions(
    predictions: Path, ranked: Indices, evaluation_set: EvaluationSet, options: ReportOptions
) -> None:
    truncated = ranked[:, : options.depth]
    rankings = Rankings(truncated, np.zeros(truncated.shape, np.float32))
    result = evaluate_rankings(evaluation_set, rankings, options, has_scores=False, about={})
    run = EvaluationRun(predictions.stem, None, {"predictions": predictions.name})
    output_results(run, [result], options)
