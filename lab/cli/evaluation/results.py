"""Output of `placewise evaluate`: metrics, reports and tables, also of a file of predictions."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.table import Column

from lab.cli.evaluation.commands import ReportOptions
from lab.datasets.dataset import DatasetPhoto, EvaluationSet
from lab.datasets.ground_truth_files import read_ground_truth, read_integer_lists
from lab.datasets.photo_lists import read_photo_list
from lab.evaluation.exact_knn import Rankings
from lab.evaluation.query_clusters import cluster_queries, singleton_clusters
from lab.evaluation.ranking import DEFAULT_KS
from lab.evaluation.report.page import format_share, write_report
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
    print_json,
    print_message,
    print_table,
    printable_path,
    refuse_unwritable,
)
from shared.errors import InvalidRequest


def check_output_folders(out: Path | None, pairs: Path | None = None) -> None:
    """Create the output folders before the long computation of results.

    Raises Misconfigured: `out_unwritable`.
    """
    for folder in filter(None, (out, pairs and pairs.parent)):
        with refuse_unwritable(folder):
            folder.mkdir(parents=True, exist_ok=True)


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

    Without a database, whose photos are unknown then, each query is a cluster of its own, and no
    distances are reported. Without `has_scores` the scores of `ranked` mean nothing. `about` are
    further figures to report, `places` those of `measure_places`.
    """
    queries, database = evaluation_set.queries, evaluation_set.database
    scores = ranked.scores if has_scores else None
    clusters, metres = singleton_clusters(len(queries)), None
    if database:
        clusters = cluster_queries(queries)
        metres = match_distances(queries, database, ranked.indices)
    measured = compute_metrics(
        ranked.indices,
        evaluation_set.positives,
        clusters,
        scores=scores,
        metres=metres,
        ks=options.ks or DEFAULT_KS,
    )
    against = None
    if options.against is not None:
        against = compare_with_run(options.against, evaluation_set, measured)
    return EvaluationResult(evaluation_set, ranked, has_scores, measured, about, against, places)


def output_results(
    run: EvaluationRun, results: Sequence[EvaluationResult], options: ReportOptions
) -> None:
    """Write the requested files and print the metrics.

    Raises Misconfigured: `out_unwritable`.
    """
    if options.out is not None:
        with refuse_unwritable(options.out):
            write_run_files(options.out, run, results)
            write_report(options.out, run, results, options.grids, options.only_wrong)
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
            format_share(share, measured.recall_intervals, at),
            format_share(recalls.recall_findable[k], measured.findable_intervals, at),
        )
    mean = format_share(measured.mean_average_precision, [measured.map_interval])
    table.add_row(f"mAP@{measured.depth}", "", mean)
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


PREDICTIONS_PROTOCOL = "predictions file"


def evaluate_predictions(
    predictions: Path, evaluation_set: EvaluationSet, options: ReportOptions
) -> None:
    """Evaluate (queries, k) database indices, best first, of an `.npy` file on a set.

    Raises:
        InvalidRequest: Errors of reading the predictions.
        Misconfigured: `out_unwritable`.
    """
    check_output_folders(options.out, options.pairs)
    ranked = read_predictions(predictions)
    check_predictions(
        predictions, ranked, evaluation_set.positives, len(evaluation_set.database) or None
    )
    truncated = ranked[:, : options.depth]
    rankings = Rankings(truncated, np.zeros(truncated.shape, np.float32))
    result = evaluate_rankings(evaluation_set, rankings, options, has_scores=False, about={})
    run = EvaluationRun(predictions.stem, None, {"predictions": predictions.name})
    output_results(run, [result], options)


def read_evaluation_set(
    ground_truth: Path,
    database: Path | None,
    queries: Path | None,
    photos: Path | None,
    name: str | None,
) -> EvaluationSet:
    """Make an evaluation set of a ground truth file and lists of photos, relative to `photos`.

    Without lists, queries are numbered, and the set has no database. Raises InvalidRequest
    (`one_list`), and errors of reading the files.
    """
    rule = f"given by {ground_truth.name}"
    of_database: tuple[DatasetPhoto, ...] = ()
    if database is not None and queries is not None:
        of_database, of_queries = (read_photo_list(each, photos) for each in (database, queries))
        positives, rule = read_ground_truth(
            ground_truth,
            database=[photo.name for photo in of_database],
            queries=[photo.name for photo in of_queries],
        )
    elif database is not None or queries is not None:
        raise InvalidRequest("one_list", "--database and --queries must be given together.")
    else:
        positives = read_integer_lists(ground_truth)
        numbers = (f"query {number}" for number in range(len(positives)))
        of_queries = tuple(DatasetPhoto(Path(number), number) for number in numbers)
    return EvaluationSet(
        name=name or ground_truth.stem,
        root=photos or ground_truth.parent,
        database=of_database,
        queries=of_queries,
        positives=tuple(positives),
        rule=rule,
        protocol=PREDICTIONS_PROTOCOL,
    )
