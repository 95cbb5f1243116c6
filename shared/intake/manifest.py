"""Lists that say where many photos were taken: CSV tables and JSONL manifests.

Both give the upload form's fields by a photo's name. A list that can't be understood is refused
as a whole, and the refusal names its lines; a value that is wrong (a latitude of 95) is its photo's
own error, found when that photo comes in.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from shared.errors import InvalidRequest, PlacewiseError
from shared.intake.photo_fields import FORM_FIELDS

MAX_MANIFEST_BYTES = 32 * 1024 * 1024
NAME_COLUMNS = ("filename", "file", "path")
CSV_COLUMNS = ("latitude", "longitude", "heading", "captured_at", "place", "tags")
KEY_FIELD = "key"  # of a manifest of objects that lie in the store
MAX_REPORTED_LINES = 20  # bad lines that a refusal names


@dataclass(frozen=True, slots=True)
class ManifestEntry:
    """What one line says of one photo."""

    line: int
    name: str
    fields: dict[str, str]
    """In the upload form's names; what is empty is left out."""


def read_csv_manifest(data: bytes, source_name: str) -> list[ManifestEntry]:
    """The rows of a table with a column of names (NAME_COLUMNS) and any of CSV_COLUMNS.

    Raises InvalidRequest (`bad_table`) that calls the table `source_name`.
    """
    try:
        reader = csv.DictReader(io.StringIO(data.decode("utf-8-sig"), newline=""))
        columns = reader.fieldnames or []
        name_column = next((c for c in NAME_COLUMNS if c in columns), None)
        if name_column is None:
            raise InvalidRequest(
                "bad_table",
                f"{source_name} has no column {' or '.join(NAME_COLUMNS)}; "
                f"beside it may stand {', '.join(CSV_COLUMNS)}. Its first line, read as "
                f"separated by commas, is {', '.join(columns) or 'empty'}.",
            )
        unknown = [c for c in columns if c not in (name_column, *CSV_COLUMNS)]
        if unknown:
            raise InvalidRequest(
                "bad_table",
                f"{source_name}: the columns {', '.join(unknown)} mean nothing here. Known are "
                f"{name_column}, {', '.join(CSV_COLUMNS)}: rename them, or take them out.",
            )
        said: list[ManifestEntry] = []
        seen: dict[str, int] = {}
        for row in reader:
            name = row[name_column] or ""  # a short row has None
            if name in seen:
                fault = f"{name!r} stands in line {seen[name]} already"
                raise bad_lines_error("bad_table", source_name, [(reader.line_num, fault)])
            seen[name] = reader.line_num
            if None in row:
                raise bad_lines_error(
                    "bad_table", source_name, [(reader.line_num, "has too many columns")]
                )
            if any("\0" in cell for cell in row.values() if cell):
                raise bad_lines_error(
                    "bad_table", source_name, [(reader.line_num, "holds a NUL character")]
                )
            fields = {c: row[c] for c in CSV_COLUMNS if row.get(c)}
            said.append(ManifestEntry(reader.line_num, name, fields))
        return said
    except (UnicodeDecodeError, csv.Error) as error:
        raise InvalidRequest("bad_table", f"Can't read {source_name}: {error}") from error


def read_jsonl_manifest(
    data: bytes, source_name: str, name_fields: Sequence[str] = NAME_COLUMNS
) -> list[ManifestEntry]:
    """The lines of a manifest: JSON objects with a name and any of the upload form's fields.

    `tags` may be a list, `metadata` an object. Empty lines are passed over. Raises InvalidRequest
    (`bad_manifest`), which names the first MOST_NAMED bad lines.
    """
    said: list[ManifestEntry] = []
    bad: list[tuple[int, str]] = []
    seen: dict[str, int] = {}
    for number, line in _lines(data):
        try:
            one = _read_line(number, line, name_fields)
        except ValueError as error:
            bad.append((number, str(error)))
        else:
            if one.name in seen:
                bad.append((number, f"{one.name!r} stands in line {seen[one.name]} already"))
            seen.setdefault(one.name, number)
            said.append(one)
        if len(bad) == MAX_REPORTED_LINES:
            break
    if bad:
        raise bad_lines_error("bad_manifest", source_name, bad)
    return said


def bad_lines_error(
    code: str, source_name: str, lines: Sequence[tuple[int, str]]
) -> PlacewiseError:
    """The refusal of a list for what is wrong in its lines, by their numbers from 1."""
    return InvalidRequest(
        code,
        "; ".join(f"{source_name}, line {line}: {detail}" for line, detail in lines) + ".",
        errors=[{"line": line, "detail": detail} for line, detail in lines],
    )


def _lines(data: bytes) -> Iterator[tuple[int, bytes]]:
    for number, line in enumerate(io.BytesIO(data.removeprefix(b"\xef\xbb\xbf")), start=1):
        if line.strip():
            yield number, line


def _read_line(number: int, line: bytes, name_fields: Sequence[str]) -> ManifestEntry:
    """ValueError says what is wrong with the line."""
    try:
        values = json.loads(line)
    except (ValueError, RecursionError):
        raise ValueError("is not JSON") from None
    if not isinstance(values, dict):
        raise ValueError("is not a JSON object")
    name_field = next((name for name in name_fields if name in values), None)
    if name_field is None:
        raise ValueError(f"has no {' or '.join(name_fields)}")
    name = values.pop(name_field)
    if not isinstance(name, str) or not name:
        raise ValueError(f"{name_field} is no text")
    _check_text(name_field, name)
    fields = {}
    for field, value in values.items():
        if field not in FORM_FIELDS:
            raise ValueError(f"{field} is unknown; known are {', '.join(FORM_FIELDS)}")
        if value is not None:
            fields[field] = _as_form_text(field, value)
    return ManifestEntry(number, name, fields)


def _as_form_text(field: str, value: Any) -> str:
    """A JSON value as the upload form has it."""
    if isinstance(value, str):
        _check_text(field, value)
        return value
    if field == "metadata" and isinstance(value, dict):
        return json.dumps(value)
    if field == "tags" and isinstance(value, list):
        if not all(isinstance(tag, str) and "," not in tag for tag in value):
            raise ValueError("tags are texts without commas")
        return _as_form_text(field, ",".join(value))
    if field in ("latitude", "longitude", "heading") and type(value) in (int, float):
        return repr(value)
    raise ValueError(f"{field} can't be {json.dumps(value)[:50]}")


def _check_text(field: str, text: str) -> None:
    """ValueError for what no database keeps."""
    if "\0" in text:
        raise ValueError(f"{field} holds a NUL character")
    try:
        text.encode()
    except UnicodeEncodeError:
        raise ValueError(f"{field} holds half of a surrogate pair") from None
