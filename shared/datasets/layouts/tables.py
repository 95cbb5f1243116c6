"""CSV tables of data sets: by their columns' names, with errors that name file and line."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path

from shared.errors import InvalidRequest, PlacewiseError


def read_table(path: Path, needed: Sequence[str]) -> Iterator[tuple[int, dict[str, str]]]:
    """Each row, by column, with its line in the file; further columns are there too.

    Raises InvalidRequest (`missing_column`, which names those that are there; `bad_table`).
    """
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file)
            columns = reader.fieldnames or []
            missing = [column for column in needed if column not in columns]
            if missing:
                raise InvalidRequest(
                    "missing_column",
                    f"{path} has no column {', '.join(missing)}. Its first line, read as separated "
                    f"by commas, is: {', '.join(columns) or 'empty'}.",
                    missing=missing,
                )
            for row in reader:
                line = reader.line_num
                if None in row or None in row.values():
                    raise bad_row_error(
                        path, line, f"has not the {len(columns)} cells of the first line"
                    )
                yield line, row
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InvalidRequest("bad_table", f"Can't read {path}: {error}.") from error


def parse_integer(path: Path, line: int, row: dict[str, str], column: str) -> int:
    """A cell as an integer; `7.0`, as data frames write it, is 7."""
    value = parse_number(path, line, row, column)
    if value != int(value):
        raise bad_row_error(path, line, f"{column} {row[column]!r} is no whole number")
    return int(value)


def parse_number(path: Path, line: int, row: dict[str, str], column: str) -> float:
    try:
        value = float(row[column])
        if abs(value) < float("inf"):
            return value
    except ValueError:
        pass
    raise bad_row_error(path, line, f"{column} {row[column]!r} is no number")


def bad_row_error(path: Path, line: int, fault: str) -> PlacewiseError:
    return InvalidRequest("bad_table", f"{path}, line {line}: {fault}.", line=line)
