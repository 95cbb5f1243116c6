"""What `placewise bench` says of its figures."""

from __future__ import annotations

import contextlib

import pytest
import typer
from typer.testing import CliRunner

from lab.benchmarks.report import LatencySummary, Report, printed_report
from services.cli.main import build_app

runner = CliRunner()
app = build_app(["bench"])


@pytest.mark.parametrize(
    ("bounds", "missed"),
    [
        ({"at_most": 10.0}, False),
        ({"at_most": 9.9}, True),
        ({"at_least": 10.0}, False),
        ({"at_least": 10.1}, True),
    ],
)
def test_figure_is_missed_beyond_its_bound(bounds: dict[str, float], missed: bool) -> None:
    report = Report("anything")
    report.add("something", 10.0, "ms", **bounds)
    assert report.missed == missed
    assert report.as_json()["figures"][0]["missed"] == missed


@pytest.mark.parametrize("missed", [True, False])
def test_missed_figure_is_exit_code_1(capsys: pytest.CaptureFixture[str], missed: bool) -> None:
    ended = contextlib.nullcontext() if not missed else pytest.raises(typer.Exit)
    with ended, printed_report("anything", as_json=False) as (report, _):
        report.add("requests failed", int(missed), at_most=0)
    assert ("missed" in capsys.readouterr().out) == missed


@pytest.mark.parametrize("widths", ["1,x", "0,1"])
def test_numbers_that_are_none_are_refused(widths: str) -> None:
    assert runner.invoke(app, ["bench", "pipeline", "--widths", widths]).exit_code == 2


def test_spread_is_of_the_slowest_too() -> None:
    found = LatencySummary.of([float(number) for number in range(100, 0, -1)])
    assert (found.median, found.p95, found.worst) == (50.5, 96.0, 100.0)
