"""Writes the metrics of sets or extractors as a CSV table."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from itertools import repeat
from pathlib import Path

from lab.evaluation.retrieval_metrics import RetrievalMetrics


def write_table(folder: Path, rows: Sequence[tuple[str, RetrievalMetrics]]) -> None:
    """Write `table.csv`, with a named row for each set or extractor.

    Shares are from 0 to 1 and have their 95 % interval.
    """
    first = rows[0][1]
    names = [*(f"R@{k}" for k in first.recalls.recall_all), f"mAP@{first.depth}"]
    columns = [f"{name}{bound}" for name in names for bound in ("", " low", " high")]
    table: list[Sequence[object]] = [["name", "queries", *columns]]
    for name, measured in rows:
        shares = [*measured.recalls.recall_all.values(), measured.mean_average_precision]
        recalls = measured.recall_intervals or repeat(None, len(shares) - 1)
        intervals = [*recalls, measured.map_interval]
        values: list[object] = []
        for share, interval in zip(shares, intervals, strict=True):
            values += [share, *(interval.as_json() if interval else ("", ""))]
        table.append([name, measured.recalls.queries, *values])
    with (folder / "table.csv").open("w", encoding="utf-8", newline="") as opened:
        csv.writer(opened, lineterminator="\n").writerows(table)
