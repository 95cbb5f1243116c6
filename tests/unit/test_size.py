"""`make size`: figures of the code beside the limits of docs/architecture.md."""

from __future__ import annotations

from pathlib import Path

from tools.size import Bound, find_violations, measure, read_bounds

PAGE = """# Architecture

| settings | 1 | 1 |

## Size

| figure | limit | aim |
|---|---|---|
| lines of the lab | 1,200 | 900 |
| files of the lab | - | - |

## Next

| commands | 1 | 1 |
"""


def test_limits_and_aims_are_those_of_the_one_table() -> None:
    assert read_bounds(PAGE) == {
        "lines of the lab": Bound(1200, 900),
        "files of the lab": Bound(None, None),
    }


def test_a_figure_above_its_limit_is_a_violation() -> None:
    bounds = read_bounds(PAGE)
    assert find_violations({"lines of the lab": 1200, "files of the lab": 80}, bounds) == []
    (violation,) = find_violations({"lines of the lab": 1201, "files of the lab": 80}, bounds)
    assert violation == "lines of the lab: 1,201 is above the limit of 1,200"


def test_a_figure_without_a_row_and_a_row_without_a_figure_are_violations() -> None:
    found = find_violations({"lines of the lab": 1, "settings": 2}, read_bounds(PAGE))
    assert found == [
        "the table has no row `settings`",
        "nothing is counted for the row `files of the lab`",
    ]


def test_python_files_are_counted_by_room(tmp_path: Path) -> None:
    for name in ("lab/a.py", "lab/b.py", "lab/c.txt", "services/d.py", "tests/lab/e.py"):
        file = tmp_path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text('"""One\n\nthree."""\n')
    figures = measure(tmp_path)
    assert (figures["files of the lab"], figures["lines of the lab"]) == (2, 6)
    assert (figures["files of the service"], figures["lines of the service"]) == (1, 3)
    assert (figures["files of the tests"], figures["lines of the tests"]) == (1, 3)
    assert figures["migrations"] == 0
