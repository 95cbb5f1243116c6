"""Renders the HTML report of an evaluation run, with inline styles, charts and photos."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from typing import Any

from lab.evaluation.report.charts import (
    STYLE,
    distance_chart,
    positions_chart,
    precision_chart,
    recall_chart,
    reliability_chart,
)
from lab.evaluation.report.retrieval_grids import differences_section, retrieval_grids
from lab.evaluation.results import EvaluationResult, EvaluationRun, package_versions
from shared.evaluation.bootstrap import ConfidenceInterval

MAX_SUSPECTS_SHOWN = 50


def render_report(
    run: EvaluationRun,
    results: Sequence[EvaluationResult],
    *,
    grids_shown: int = 12,
    only_wrong: bool = False,
) -> str:
    """Render the report of a run as one HTML document.

    Args:
        grids_shown: maximum number of queries per retrieval grid.
        only_wrong: omit the grid of correct queries.
    """
    title = f"Evaluation of {run.name}"
    about = {"model": run.name, "fingerprint": run.fingerprint or "unknown", **run.about}
    versions = ", ".join(f"{name} {number}" for name, number in package_versions().items())
    sections = "".join(_set_section(result, grids_shown, only_wrong) for result in results)
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{STYLE}</style></head><body>"
        f"<h1>{escape(title)}</h1>{_facts_table(about)}"
        f'<p class="note">Created with {escape(versions)}.</p>{sections}</body></html>\n'
    )


def _set_section(result: EvaluationResult, grids_shown: int, only_wrong: bool) -> str:
    evaluation_set = result.evaluation_set
    database = evaluation_set.database
    facts = {
        "database": f"{len(database)} photos" if database else "not listed",
        "queries": f"{len(evaluation_set.queries)}, of which "
        f"{result.measured.recalls.without_positive} have no positive in the database",
        "positive-match criterion": evaluation_set.rule,
        "protocol": evaluation_set.protocol,
        "fingerprint": evaluation_set.fingerprint,
    }
    parts = [f"<h2>{escape(evaluation_set.name)}</h2>", _facts_table(facts), _metrics_table(result)]
    parts.append(_published_table(result))
    charts = [recall_chart(result), precision_chart(result), distance_chart(result)]
    figures = "".join(f"<figure>{chart}</figure>" for chart in charts if chart)
    parts.append(f'<div class="charts">{figures}</div>')
    if result.places is not None:
        parts.append(_places_section(result.places))
    if result.against:
        parts.append(differences_section(result, result.against, grids_shown))
    if (positions := positions_chart(result)) is not None:
        chart, caption = positions
        parts.append(
            f"<h3>Map</h3><figure>{chart}<figcaption>{escape(caption)}. A line joins each query "
            "with its first match: green if it is correct, red if not. Grey: database photos."
            "</figcaption></figure>"
        )
    parts.append(_audit_section(result))
    for heading, table in retrieval_grids(result, grids_shown, only_wrong=only_wrong):
        parts.append(f"<h3>{escape(heading)}</h3>{table}")
    return f"<section>{''.join(parts)}</section>"


def _metrics_table(result: EvaluationResult) -> str:
    measured = result.measured
    kind = measured.clusters.kind
    rows = []
    intervals, findable_intervals = measured.recall_intervals, measured.findable_intervals
    for index, (k, recall) in enumerate(measured.recalls.recall_all.items()):
        rows.append(
            (
                f"R@{k}",
                _format_share(recall, intervals[index] if intervals else None),
                _format_share(
                    measured.recalls.recall_findable[k],
                    findable_intervals[index] if findable_intervals else None,
                ),
            )
        )
    rows.append(
        (
            f"mAP@{measured.depth}",
            "",
            _format_share(measured.mean_average_precision, measured.map_interval),
        )
    )
    body = "".join(
        f'<tr><th>{name}</th><td class="n">{a}</td><td class="n">{b}</td></tr>'
        for name, a, b in rows
    )
    note = (
        f"95 % intervals: bootstrap over {measured.clusters.count} {kind}."
        if measured.recall_intervals
        else "Too few queries for intervals."
    )
    return (
        "<table><tr><th></th><th>all queries</th><th>queries with a positive</th></tr>"
        f'{body}</table><p class="note">{escape(note)}</p>{_facts_table(_other_metrics(result))}'
    )


def _other_metrics(result: EvaluationResult) -> dict[str, Any]:
    measured, facts = result.measured, dict[str, Any]()
    if (calibration := measured.calibration) is not None:
        facts["AUROC of the first match's score"] = _format_number(calibration.auroc)
        facts["calibration error (ECE)"] = _format_number(calibration.calibration_error)
        facts["recall at 99 % precision"] = f"{calibration.recall_at_99_precision:.1%}"
    if measured.curve is not None:
        facts["area under the precision-recall curve"] = f"{measured.curve.area:.3f}"
    for name, value in result.about.items():
        facts[name.replace("_", " ")] = f"{value:.1f}" if isinstance(value, float) else value
    return facts


def _places_section(places: dict[str, Any]) -> str:
    """Answers at each certainty, and the reliability of the levels (`measure_places`)."""
    heads = "".join(
        f"<th>{head}</th>"
        for head in (
            "certainty",
            "answered",
            "at the finest level",
            "correct",
            "mean level",
            "outside the map, at the finest level",
        )
    )
    rows = "".join(
        f"<tr><th>{each['certainty']:g}</th>"
        + "".join(
            f'<td class="n">{cell}</td>'
            for cell in (
                *(
                    _format_figure(each[key])
                    for key in ("answered", "answered_at_finest_level", "precision")
                ),
                "-" if each["mean_level"] is None else f"{each['mean_level']:.2f}",
                _format_percent(each["outside_at_finest_level"]),
            )
        )
        + "</tr>"
        for each in places["answers"]
    )
    errors = {
        f"level {level['level']}: calibration error (ECE)": (
            f"{_format_number(level['calibration_error'])} over {level['samples']} queries, "
            f"{_format_percent(level['accuracy'])} correct"
        )
        for level in places["levels"]
    }
    source = f"The probabilities were fitted on {places['own_photos']} database photos"
    if places["source"] == "prior":
        source = "The data set has too few photos of known places: nothing is answered"
    return (
        f"<h3>Levels of places</h3><table><tr>{heads}</tr>{rows}</table>"
        f'<p class="note">{source}. {places["samples"]} queries have an estimate and a known '
        "location. Level 0 is the finest. 95 % intervals: bootstrap over queries.</p>"
        f"<figure>{reliability_chart(places['levels'])}</figure>{_facts_table(errors)}"
    )


def _format_figure(figure: dict[str, Any]) -> str:
    text = _format_percent(figure["mean"])
    if figure["interval"] is None:
        return text
    return "{} ({:.1%} to {:.1%})".format(text, *figure["interval"])


def _format_percent(share: float | None) -> str:
    return "-" if share is None else f"{share:.1%}"


def _published_table(result: EvaluationResult) -> str:
    if not result.published:
        return (
            '<p class="note">No published results are shown: none are known for this protocol and '
            "fingerprint.</p>"
        )
    rows = "".join(
        f"<tr><th>{escape(each.method)}</th><td>"
        + ", ".join(f"R@{k} {recall:.1%}" for k, recall in each.recall.items())
        + f"</td><td>{escape(each.source)}</td></tr>"
        for each in result.published
    )
    return f"<h3>Published results on the same set</h3><table>{rows}</table>"


def _audit_section(result: EvaluationResult) -> str:
    if not result.suspects:
        return ""
    rows = "".join(
        f"<tr><td>{escape(each.query_name)}</td><td>{escape(each.database_name)}</td>"
        f'<td class="n">{_format_number(each.score)}</td><td '
        f'class="n">{_format_rounded(each.metres)}</td>'
        f'<td class="n">{_format_rounded(each.degrees)}</td></tr>'
        for each in result.suspects[:MAX_SUSPECTS_SHOWN]
    )
    heads = "".join(
        f"<th>{head}</th>" for head in ("query", "first match", "score", "metres", "degrees")
    )
    shown = min(MAX_SUSPECTS_SHOWN, len(result.suspects))
    return (
        "<h3>Label audit</h3><p>Confident first matches that count as wrong but are just outside "
        "the positive-match criterion. Check whether they show the same place before you rely on "
        f"the metrics. {shown} of {len(result.suspects)}, most confident first.</p>"
        f'<div class="wide"><table><tr>{heads}</tr>{rows}</table></div>'
    )


def _format_rounded(value: float | None) -> str:
    return "-" if value is None else f"{value:.0f}"


def _facts_table(facts: dict[str, Any]) -> str:
    rows = "".join(
        f"<tr><th>{escape(name)}</th><td><code>{escape(str(value))}</code></td></tr>"
        for name, value in facts.items()
        if value is not None
    )
    return f"<table>{rows}</table>" if rows else ""


def _format_share(share: float, interval: ConfidenceInterval | None) -> str:
    if math.isnan(share):  # no queries
        return "-"
    if interval is None:
        return f"{share:.1%}"
    return f"{share:.1%} ({interval.as_percent()})"


def _format_number(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.3f}"
