"""What `placewise compare --extractors` means, and charts of reports."""

from __future__ import annotations

import base64
import csv
from pathlib import Path

import numpy as np
import pytest

from lab.cli.evaluation.compare_extractors import ComparisonEntry, parse_entries
from lab.evaluation.query_clusters import singleton_clusters
from lab.evaluation.report.charts import percent_chart, render_chart
from lab.evaluation.report.tables import write_table
from lab.evaluation.retrieval_metrics import compute_metrics
from shared.errors import InvalidRequest


def test_commas_separate_extractors_and_their_options() -> None:
    read = parse_entries("a,b:layer=9,facet=key+pca512, c+fit,runs/last.ckpt+pca64")
    assert read == [
        ComparisonEntry("a", "a"),
        ComparisonEntry("b:layer=9,facet=key+pca512", "b:layer=9,facet=key", pca=512),
        ComparisonEntry("c+fit", "c", fit=True),
        ComparisonEntry("runs/last.ckpt+pca64", "runs/last.ckpt", pca=64),
    ]


@pytest.mark.parametrize("text", ["a,,b", "+fit", "a+pca0", "a+pca512x", "a+other"])
def test_invalid_lists_of_extractors_are_refused(text: str) -> None:
    with pytest.raises(InvalidRequest) as refused:
        parse_entries(text)
    assert refused.value.code == "bad_extractors"


def test_equal_charts_have_equal_bytes_and_their_labels_are_text() -> None:
    def chart() -> str:
        figure, axes = percent_chart("metres", "recall", x_ticks=(1, 10), log=True)
        axes.plot([1, 10], [0.2, 0.8], label="all queries")
        axes.legend()
        return render_chart(figure, "Recall & more")

    one = chart()
    assert chart() == one
    assert one.endswith('alt="Recall &amp; more">')
    svg = base64.b64decode(one.partition("base64,")[2].partition('"')[0]).decode()
    assert "all queries" in svg
    assert "dc:date" not in svg


def test_table_has_a_row_for_each_extractor(tmp_path: Path) -> None:
    ranked = np.array([[0, 1], [1, 0]])
    measured = compute_metrics(ranked, [np.array([0]), np.array([0])], singleton_clusters(2))
    write_table(tmp_path, [(r"a_b+pca50%~C:\d", measured)])
    header, values = csv.reader((tmp_path / "table.csv").read_text().splitlines())
    assert header[:5] == ["name", "queries", "R@1", "R@1 low", "R@1 high"]
    assert values[:5] == [r"a_b+pca50%~C:\d", "2", "0.5", "", ""]
