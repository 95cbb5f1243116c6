"""The page itself: one HTML text with its styles, charts and photos in it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from typing import Any

from shared.evaluation.bootstrap import ConfidenceInterval
from shared.evaluation.report.charts import (
    STYLE,
    distance_chart,
    positions_chart,
    precision_chart,
    recall_chart,
)
from shared.evaluation.report.retrieval_grids import differences_section, retrieval_grids
from shared.evaluation.results import EvaluationResult, EvaluationRun, package_versions

MAX_SUSPECTS_SHOWN = 50


def render_report(
    run: EvaluationRun,
    results: Sequence[EvaluationResult],
    *,
    grids_shown: int = 12,
    only_wrong: bool = False,
) -> str:
    """The report of a run; at most `grids_shown` queries of a kind are shown with their photos."""
    title = f"Evaluation of {run.name}"
    about = {"model": run.name, "fingerprint": run.fingerprint or "not known", **run.about}
    made_with = ", ".join(f"{name} {number}" for name, number in package_versions().items())
    sections = "".join(_set_section(one, grids_shown, only_wrong) for one in results)
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{STYLE}</style></head><body>"
        f"<h1>{escape(title)}</h1>{_facts_table(about)}"
        f'<p class="note">Made with {escape(made_with)}.</p>{sections}</body></html>\n'
    )


def _set_section(result: EvaluationResult, grids_shown: int, only_wrong: bool) -> str:
    asked = result.asked
    facts = {
        "database": f"{len(asked.database)} photos" if asked.database else "not listed",
        "queries": f"{len(asked.queries)}, of which {result.measured.recalls.without_positive} "
        "have no right photo in the database",
        "right is": asked.rule,
        "protocol": asked.protocol,
        "fingerprint": asked.fingerprint,
    }
    parts = [f"<h2>{escape(asked.name)}</h2>", _facts_table(facts), _metrics_table(result)]
    parts.append(_published_table(result))
    charts = [recall_chart(result), precision_chart(result), distance_chart(result)]
    drawn = "".join(f"<figure>{chart}</figure>" for chart in charts if chart)
    parts.append(f'<div class="charts">{drawn}</div>')
    if result.against:
        parts.append(differences_section(result, result.against, grids_shown))
    if (positions := positions_chart(result)) is not None:
        drawn, said = positions
        parts.append(
            f"<h3>Map</h3><figure>{drawn}<figcaption>{escape(said)}. Each query is joined with its "
            "first match: green where that is right, red where not. Grey: the database."
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
    for place, (k, share) in enumerate(measured.recalls.recall_all.items()):
        own = measured.recall_intervals
        other = measured.findable_intervals
        rows.append(
            (
                f"R@{k}",
                _format_share(share, own[place] if own else None),
                _format_share(measured.recalls.recall_findable[k], other[place] if other else None),
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
    said = (
        f"95 % intervals: a bootstrap over {measured.clusters.count} {kind}."
        if measured.recall_intervals
        else "Too few queries for intervals."
    )
    return (
        "<table><tr><th></th><th>of all queries</th><th>of those with a right photo</th></tr>"
        f'{body}</table><p class="note">{escape(said)}</p>{_facts_table(_other_metrics(result))}'
    )


def _other_metrics(result: EvaluationResult) -> dict[str, Any]:
    measured, said = result.measured, dict[str, Any]()
    if (found := measured.calibration) is not None:
        said["AUROC of the first score"] = _format_number(found.auroc)
        said["calibration error (ECE)"] = _format_number(found.calibration_error)
        said["recall at 99 % precision"] = f"{found.recall_at_99_precision:.1%}"
    if measured.curve is not None:
        said["area under precision and recall"] = f"{measured.curve.area:.3f}"
    for name, value in result.about.items():
        said[name.replace("_", " ")] = f"{value:.1f}" if isinstance(value, float) else value
    return said


def _published_table(result: EvaluationResult) -> str:
    if not result.published:
        return (
            '<p class="note">No published figure is shown beside these: none is known that was '
            "measured on a set of this protocol and fingerprint.</p>"
        )
    rows = "".join(
        f"<tr><th>{escape(one.method)}</th><td>"
        + ", ".join(f"R@{k} {share:.1%}" for k, share in one.recall.items())
        + f"</td><td>{escape(one.source)}</td></tr>"
        for one in result.published
    )
    return f"<h3>Published on the same set</h3><table>{rows}</table>"


def _audit_section(result: EvaluationResult) -> str:
    if not result.suspects:
        return ""
    rows = "".join(
        f"<tr><td>{escape(one.query_name)}</td><td>{escape(one.database_name)}</td>"
        f'<td class="n">{_format_number(one.score)}</td><td '
        f'class="n">{_format_rounded(one.metres)}</td>'
        f'<td class="n">{_format_rounded(one.degrees)}</td></tr>'
        for one in result.suspects[:MAX_SUSPECTS_SHOWN]
    )
    heads = "".join(
        f"<th>{head}</th>" for head in ("query", "first match", "score", "metres", "degrees")
    )
    shown = min(MAX_SUSPECTS_SHOWN, len(result.suspects))
    return (
        "<h3>Audit</h3><p>Confident first matches that count as wrong but lie just outside of the "
        "rule. Look at them before you believe the figures: they may show the place. "
        f"{shown} of {len(result.suspects)}, the most confident first.</p>"
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
    if math.isnan(share):  # no query to take it of
        return "-"
    if interval is None:
        return f"{share:.1%}"
    return f"{share:.1%} ({100 * interval.low:.1f} to {100 * interval.high:.1f})"


def _format_number(value: float | None) -> str:
    return "not known" if value is None else f"{value:.3f}"
