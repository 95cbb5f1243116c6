"""Writes what papers need: a CSV table, the rows of a LaTeX table, and charts as PDF figures."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from itertools import repeat
from pathlib import Path

from lab.evaluation.report.charts import Chart
from lab.evaluation.retrieval_metrics import RetrievalMetrics

LATEX = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
LATEX |= {character: f"\\{character}" for character in "&%$#_{}"}


def write_tables(folder: Path, rows: Sequence[tuple[str, RetrievalMetrics]]) -> None:
    """Write `table.csv` and `table.tex`, with a named row for each set or extractor.

    Shares have their 95 % interval: in `table.csv` from 0 to 1, in `table.tex` in per cent.
    """
    first = rows[0][1]
    names = [*(f"R@{k}" for k in first.recalls.recall_all), f"mAP@{first.depth}"]
    columns = [f"{name}{bound}" for name in names for bound in ("", " low", " high")]
    table: list[Sequence[object]] = [["name", "queries", *columns]]
    latex = [f"% name & {' & '.join(names)}: per cent (95 % interval)"]
    for name, measured in rows:
        shares = [*measured.recalls.recall_all.values(), measured.mean_average_precision]
        recalls = measured.recall_intervals or repeat(None, len(shares) - 1)
        intervals = [*recalls, measured.map_interval]
        values: list[object] = []
        cells = ["".join(LATEX.get(character, character) for character in name)]
        for share, interval in zip(shares, intervals, strict=True):
            values += [share, *(interval.as_json() if interval else ("", ""))]
            bounds = f" ({100 * interval.low:.1f}--{100 * interval.high:.1f})" if interval else ""
            cells.append(f"{100 * share:.1f}{bounds}")
        table.append([name, measured.recalls.queries, *values])
        latex.append(rf"{' & '.join(cells)} \\")
    with (folder / "table.csv").open("w", encoding="utf-8", newline="") as opened:
        csv.writer(opened, lineterminator="\n").writerows(table)
    (folder / "table.tex").write_text("\n".join(latex) + "\n", encoding="utf-8")


def write_figures(folder: Path, name: str, charts: Sequence[Chart | None]) -> None:
    """Write each chart as `NAME_TITLE.pdf`; equal charts have equal bytes."""
    for chart in filter(None, charts):
        file = re.sub(r"\W+", "_", f"{name} {chart.caption}".lower())
        chart.figure.savefig(folder / f"{file}.pdf", metadata={"CreationDate": None})
