"""Tables of commands: readable in 80 columns on a terminal, tab-separated elsewhere."""

from __future__ import annotations

import re

import pytest
from rich.progress_bar import ProgressBar

from services.cli import output
from services.cli.output import Table, print_message, print_table, progress_bar

LONG_PATH = "queries/midrise/" + "very-" * 20 + "long/frame_000123.jpg"
MAP = "the-map-of-the-whole-building-with-all-its-floors-2026"
EXTRACTOR = "efficientnet-lite0-vlad128:clusters=256"
HEAD = ["map", "photos", "extractor", "vocabulary", "dimension", "photo"]
ROW = [MAP, "1234567", EXTRACTOR, "foreign", "512 (PCA of 14336)", LONG_PATH]


def make_table() -> Table:
    table = Table(*HEAD, "")
    table.add_row(*ROW, ProgressBar(total=1, completed=0.5, width=4))
    return table


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TTY_COMPATIBLE", "1")
    monkeypatch.setenv("COLUMNS", "80")


@pytest.mark.usefixtures("terminal")
def test_long_names_continue_below_to_fit_80_columns(capsys: pytest.CaptureFixture[str]) -> None:
    print_table(make_table())
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    first = next(number for number, line in enumerate(lines) if "1234567" in line)
    assert " foreign " in lines[first]
    for name in (MAP, EXTRACTOR, LONG_PATH):
        begin = lines[first].index(name[:8])
        below = "".join(line[begin:].split(" ")[0] for line in lines[first:])
        assert below == name, "each name is whole"


@pytest.mark.usefixtures("terminal")
def test_a_terminal_gets_no_escape_sequences_of_names(capsys: pytest.CaptureFixture[str]) -> None:
    name = "\x1b]0;owned\x9b2J\u202egpj.exe"
    table = Table("photo", "text")
    table.add_row(name, f"a text with {name} in it")
    print_table(table)
    print_message(f"first line\n{name}")
    with progress_bar() as progress:
        progress.add_task(name, total=1)
    printed = "".join(capsys.readouterr())
    assert printed.count("\ufffd]0;owned\ufffd2J\ufffdgpj.exe") == 3
    assert "\ufffd]0;owned" in printed.splitlines()[-2], "the progress bar"
    assert "\x1b]" not in printed
    assert "\x9b" not in printed
    assert "\u202e" not in printed, "would show photo.exe as photoexe.jpg"
    assert "first line\n" in printed


@pytest.mark.usefixtures("terminal")
def test_beside_many_columns_a_name_continues_below_and_numbers_stay_whole(
    capsys: pytest.CaptureFixture[str],
) -> None:
    table = Table("places", "R@1", "R@5", "R@10", "R@20", "R@1 95 % CI", "ms", "bytes", "vs. first")
    figures = ("56.7", "73.3", "76.7", "86.7", "37.5 to 77.8", "222.4", "57,344")
    table.add_row("efficientnet-lite0-vlad128+fit", *figures, "+16.7 (+3.3 to +32.4)")
    print_table(table)
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    row = next(line for line in lines if "222.4" in line)
    assert row.startswith("effic")
    assert "  56.7  73.3  76.7  86.7  37.5 to 77.8  222.4  57,344  +16.7" in row
    assert "28+fit" in lines[lines.index(row) + 2]


def test_output_that_is_no_terminal_is_tab_separated_with_full_names(
    capsys: pytest.CaptureFixture[str],
) -> None:
    print_table(make_table())
    head, row = capsys.readouterr().out.splitlines()
    assert head.split("\t") == HEAD, "the column of bars, which has no header, is left out"
    assert row.split("\t") == ROW


def test_tab_separated_cells_hold_no_markup_tabs_or_line_breaks(
    capsys: pytest.CaptureFixture[str],
) -> None:
    table = Table("name", "note", title="two words", caption="a caption")
    table.add_row("[bold]a\\[b].jpg[/bold]", "one\ttwo\nthree")
    table.add_row(None, "")
    print_table(table)
    assert capsys.readouterr().out.splitlines() == [
        "two words",
        "name\tnote",
        "a[b].jpg\tone two three",
        "\t",
        "a caption",
    ]


def test_progress_is_a_line_from_time_to_time_where_stderr_is_not_a_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with progress_bar() as progress:
        bar = progress.add_task("reading a", total=3000)
        progress.update(bar, completed=1000)
    assert capsys.readouterr().err == "", "a short command prints none"
    monkeypatch.setattr(output, "LINE_SECONDS", 0)
    progress.update(bar, completed=1000)
    progress.advance(bar)
    assert re.findall(r"reading a: (.*), \d+ s\n", capsys.readouterr().err) == [
        "1,000 of 3,000",
        "1,001 of 3,000",
    ]
