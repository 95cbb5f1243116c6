"""What `placewise evaluate` writes and prints of its results."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from rich.table import Column, Table

from services.cli.evaluate import Wanted
from services.cli.output import answers, print_json, shown
from services.trainer.evaluation.against import compare_with
from services.trainer.evaluation.bootstrap import Interval
from services.trainer.evaluation.clusters import alone, clusters_of
from services.trainer.evaluation.measure import measure
from services.trainer.evaluation.metres import metres_of
from services.trainer.evaluation.nearest import Ranked
from services.trainer.evaluation.recalls import KS
from services.trainer.evaluation.report.page import page
from services.trainer.evaluation.result import Result, Run
from services.trainer.evaluation.write import metrics, write_files, write_pairs
from shared.datasets.published import published_on
from shared.datasets.sets import EvaluationSet
from shared.errors import Misconfigured


def check_out(wanted: Wanted) -> None:
    """Before the minutes that describing takes: whether results can be written where they are
    wanted; Misconfigured (`out_unwritable`)."""
    try:
        if wanted.out is not None:
            wanted.out.mkdir(parents=True, exist_ok=True)
        if wanted.pairs is not None:
            wanted.pairs.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _unwritable(wanted.out or wanted.pairs, error) from error


def result_of(
    asked: EvaluationSet,
    ranked: Ranked,
    wanted: Wanted,
    *,
    has_scores: bool,
    about: dict[str, object],
) -> Result:
    """All figures of one set, and those against an earlier run."""
    measured = measure(
        ranked.indices,
        asked.positives,
        clusters_of(asked.queries) if asked.database else alone(len(asked.queries)),
        scores=ranked.scores if has_scores else None,
        metres=(
            metres_of(asked.queries, asked.database, ranked.indices) if asked.database else None
        ),
        ks=KS,
    )
    against = None
    if wanted.against is not None:
        against = compare_with(
            wanted.against, asked.name, asked.fingerprint, measured, asked.positives
        )
    return Result(
        asked,
        ranked,
        has_scores,
        measured,
        about,
        against=against,
        published=published_on(asked),
    )


def finish(run: Run, results: Sequence[Result], wanted: Wanted) -> None:
    """Write what is wanted, print the figures."""
    try:
        if wanted.out is not None:
            write_files(wanted.out, run, results)
            report = page(run, results, grids_shown=wanted.grids, only_wrong=wanted.only_wrong)
            (wanted.out / "report.html").write_text(report, encoding="utf-8")
        if wanted.pairs is not None:
            write_pairs(wanted.pairs, results)
    except OSError as error:
        raise _unwritable(wanted.out or wanted.pairs, error) from error
    if wanted.as_json:
        found = metrics(run, results)
        if len(results) == 1:  # a program that asks about one set need not know its name
            found |= found["sets"][results[0].asked.name]
        print_json(found)
        return
    for result in results:
        _print(result)
    if wanted.out is not None:
        answers.print(f"{shown(wanted.out / 'report.html')}", soft_wrap=True, markup=False)


def _print(result: Result) -> None:
    asked, measured = result.asked, result.measured
    recalls = measured.recalls
    table = Table(
        asked.name,
        Column(f"all {recalls.queries} queries", justify="right"),
        Column(f"{recalls.queries - recalls.without_positive} with a positive", justify="right"),
    )
    for at, (k, share) in enumerate(recalls.of_all.items()):
        table.add_row(
            f"R@{k}",
            _cell(share, measured.recall_intervals, at),
            _cell(recalls.of_findable[k], measured.findable_intervals, at),
        )
    mean, within = measured.mean_average_precision, measured.map_interval
    table.add_row(f"mAP@{measured.depth}", "", _cell(mean, [within] if within else None, 0))
    answers.print(table)
    answers.print(
        f"Right: {asked.rule}; protocol {asked.protocol}; fingerprint {asked.fingerprint[:16]}; "
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
            within = (
                f" ({100 * found.low:+.1f} to {100 * found.high:+.1f})"
                if found.low is not None and found.high is not None
                else ""
            )
            answers.print(
                f"R@{k} {100 * found.mean:+.1f} points{within} against {result.against.other}: "
                f"{found.won} won, {found.lost} lost.",
                soft_wrap=True,
                markup=False,
            )


def _cell(share: float, found: Sequence[Interval] | None, at: int) -> str:
    if math.isnan(share):  # no query to take it of
        return "-"
    if found is None:
        return f"{100 * share:.1f} %"
    return f"{100 * share:.1f} % ({100 * found[at].low:.1f} to {100 * found[at].high:.1f})"


def _unwritable(path: Path | None, error: OSError) -> Misconfigured:
    return Misconfigured("out_unwritable", f"{path} can't be written: {error.strerror}.")
