"""Renders the HTML reports of evaluations from the folder `templates`.

A report is one file: its charts and photos are inside, and it fetches nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from lab.evaluation.report.charts import (
    distance_chart,
    positions_chart,
    precision_chart,
    recall_chart,
    reliability_chart,
)
from lab.evaluation.report.retrieval_grids import changed_grids, retrieval_grids
from lab.evaluation.report.tables import write_table
from lab.evaluation.results import EvaluationResult, EvaluationRun, package_versions
from shared.evaluation.bootstrap import ConfidenceInterval


def write_report(
    out: Path,
    run: EvaluationRun,
    results: Sequence[EvaluationResult],
    grids_shown: int,
    only_wrong: bool,
) -> None:
    """Write the report of a run, `report.html`, and its table.

    Args:
        grids_shown: maximum number of queries per retrieval grid.
        only_wrong: omit the grid of correct queries.
    """
    sections: list[dict[str, Any]] = []
    for result in results:
        charts = recall_chart(result), precision_chart(result), distance_chart(result)
        levels = result.places and reliability_chart(result.places["levels"])
        positions = positions_chart(result)
        sections.append({
            "result": result, "charts": charts, "levels_chart": levels, "map": positions,
            "changed_grids": changed_grids(result, grids_shown),
            "grids": retrieval_grids(result, grids_shown, only_wrong=only_wrong),
        })  # fmt: skip
    write_table(out, [(each.evaluation_set.name, each.measured) for each in results])
    page = _templates.get_template("evaluation.html").render(
        title=f"Evaluation of {run.name}",
        about={"model": run.name, "fingerprint": run.fingerprint or "unknown", **run.about},
        versions=", ".join(f"{name} {number}" for name, number in package_versions().items()),
        sections=sections,
    )
    (out / "report.html").write_text(page, encoding="utf-8")


def format_share(
    share: float, intervals: Sequence[ConfidenceInterval | None] | None, index: int = 0
) -> str:
    """Return a share in per cent, with its interval if there is one; a dash for NaN."""
    interval = intervals[index] if intervals else None
    if interval is None or math.isnan(share):
        return _format_percent(share)
    return f"{_format_percent(share)} ({interval.as_percent()})"


def _format_percent(share: float | None) -> str:
    return "-" if share is None or math.isnan(share) else f"{100 * share:.1f} %"


def _format_number(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.3f}"


_templates = Environment(
    loader=FileSystemLoader(Path(__file__).parent / "templates"),
    autoescape=True,
    trim_blocks=True,
    lstrip_blocks=True,
    undefined=StrictUndefined,
)
_templates.filters |= {"share": format_share, "percent": _format_percent, "number": _format_number}
