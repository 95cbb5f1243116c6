"""What `placewise bench` says of its figures."""

from __future__ import annotations

import contextlib

import pytest
import typer

from lab.benchmarks.report import Report, printed_report


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
