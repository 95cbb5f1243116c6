"""Photo metadata of uploads: form fields, CSV tables and JSONL manifests.

Every error names its field. CSV tables and JSONL manifests give the fields of the upload form by
photo name. A manifest that can't be parsed is rejected as a whole, with its line numbers. A wrong
value (a latitude of 95) is an error of its photo alone, reported when that photo is stored.
"""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from shared.enums import PhotoRole
from shared.errors import InvalidRequest, PlacewiseError, TooLarge, invalid_field_error, shorten
from shared.imaging.capture_place import MAX_ALTITUDE_M, is_null_island

MAX_TAGS = 50
MAX_METADATA_CHARACTERS = 100_000
MAX_METADATA_FIELDS = 10_000  # at the top level
MAX_METADATA_DEPTH = 32  # serialising a response fails at 255 levels
MAX_TEXT_CHARACTERS = 500  # characters of a tag or a place
MAX_PATH_CHARACTERS = 1000
DRIVE = re.compile("[A-Za-z]:")

# An escaped NUL in JSON; after an escaped backslash the same characters are plain text.
JSON_NUL = re.compile(r"(?<!\\)(?:\\\\)*\\u0000")


@dataclass(frozen=True, slots=True)
class PhotoFields:
    """Metadata of a photo as the client sent it; None for a missing field."""

    latitude: float | None = None
    longitude: float | None = None
    altitude: float | None = None
    heading: float | None = None
    captured_at: datetime | None = None
    place: str | None = None
    tags: list[str] | None = None
    metadata: dict[str, Any] | None = None
    role: PhotoRole | None = None
    relative_path: str | None = None


FORM_FIELDS = tuple(PhotoFields.__slots__)


def read_form_fields(form: dict[str, str]) -> PhotoFields:
    """Parse the text fields of the upload form.

    An empty field counts as missing.

    Raises:
        Unprocessable: `invalid_field` for an invalid value or an unknown field.
    """
    for name in form:
        if name not in FORM_FIELDS:
            raise invalid_field_error(
                name, f"is unknown; the known fields are {', '.join(FORM_FIELDS)}"
            )
    values = {name: value.strip() for name, value in form.items() if value.strip()}
    latitude, longitude = coordinate_pair(
        _number(values, "latitude", -90, 90), _number(values, "longitude", -180, 180)
    )
    heading = _number(values, "heading", 0, 360)
    return PhotoFields(
        latitude=latitude,
        longitude=longitude,
        altitude=_number(values, "altitude", -MAX_ALTITUDE_M, MAX_ALTITUDE_M),
        heading=None if heading is None else heading % 360,
        captured_at=parse_time("captured_at", values["captured_at"])
        if "captured_at" in values
        else None,
        place=_text("place", values["place"]) if "place" in values else None,
        tags=parse_tags(values["tags"].split(",")) if "tags" in values else None,
        metadata=_metadata(values["metadata"]) if "metadata" in values else None,
        role=_role(values["role"]) if "role" in values else None,
        relative_path=parse_relative_path(values.get("relative_path", "")),
    )


def coordinate_pair(
    latitude: float | None, longitude: float | None
) -> tuple[float | None, float | None]:
    """Return both coordinates; 0, 0 are none, since receivers without a fix write them.

    Raises:
        Unprocessable: `invalid_field` where only one is set.
    """
    if (latitude is None) != (longitude is None):
        missing = "latitude" if latitude is None else "longitude"
        raise invalid_field_error(
            missing, "is missing: set both latitude and longitude, or neither"
        )
    if latitude is None or longitude is None or is_null_island(latitude, longitude):
        return None, None
    return latitude, longitude


def parse_time(field: str, text: str) -> datetime:
    """Parse an ISO 8601 time into UTC; without an offset it is UTC.

    Raises:
        Unprocessable: `invalid_field`.
    """
    # A `+` in a query string is decoded as a blank unless the client wrote %2B.
    text = re.sub(r"(?<=:\d\d) (?=\d\d:?\d\d$)", "+", text)
    try:
        parsed = datetime.fromisoformat(text)
    except ValueError:
        raise invalid_field_error(
            field, f"{text!r} is not an ISO 8601 time such as 2026-05-01T12:30:00+02:00"
        ) from None
    parsed = parsed if parsed.tzinfo else parsed.replace(tzinfo=UTC)
    try:
        return parsed.astimezone(UTC)
    except OverflowError:
        raise invalid_field_error(field, f"{text!r} is out of range") from None


def parse_tags(tags: list[str]) -> list[str]:
    """Strip and deduplicate tags, keeping their order."""
    unique = list(dict.fromkeys(_text("tags", tag.strip()) for tag in tags if tag.strip()))
    if len(unique) > MAX_TAGS:
        raise invalid_field_error("tags", f"at most {MAX_TAGS} tags are allowed")
    return unique


def parse_relative_path(text: str) -> str | None:
    """Normalise the path of a photo in its folder or archive: `Day 2/IMG_2078.jpg`.

    It is a label and is never opened: drives, `.`, `..` and unprintable characters are dropped, and
    of a longer path the last MAX_PATH_CHARACTERS remain. None if nothing remains.
    """
    parts = ("".join(c for c in part if c.isprintable()) for part in re.split(r"[/\\]", text))
    kept = [part for part in parts if part not in ("", ".", "..") and not DRIVE.fullmatch(part)]
    path = "/".join(kept)
    if len(path) > MAX_PATH_CHARACTERS:
        # The end may begin with what has to be dropped: `/1.jpg`, or `../1.jpg` of `a../1.jpg`.
        return parse_relative_path(path[-MAX_PATH_CHARACTERS:])
    return path or None


def _number(values: dict[str, str], field: str, minimum: float, maximum: float) -> float | None:
    if field not in values:
        return None
    try:
        number = float(values[field])
    except ValueError:
        raise invalid_field_error(field, f"{values[field]!r} is not a number") from None
    if not math.isfinite(number) or not minimum <= number <= maximum:
        raise invalid_field_error(
            field, f"{values[field]} is not between {minimum:g} and {maximum:g}"
        )
    return number


def _text(field: str, text: str) -> str:
    if len(text) > MAX_TEXT_CHARACTERS:
        raise invalid_field_error(field, f"is longer than {MAX_TEXT_CHARACTERS} characters")
    if "\0" in text:
        raise invalid_field_error(field, "contains a NUL character")
    return text


def _role(text: str) -> PhotoRole:
    try:
        return PhotoRole(text)
    except ValueError:
        raise invalid_field_error(
            "role", f"{text!r} is not one of {', '.join(PhotoRole)}"
        ) from None


def _metadata(text: str) -> dict[str, Any]:
    error: PlacewiseError = invalid_field_error("metadata", "is not a JSON object")
    try:
        value = json.loads(text, parse_constant=_reject_constant)
    except (ValueError, RecursionError):
        raise error from None
    if not isinstance(value, dict):
        raise error
    check_metadata(value)
    return value


def check_metadata(value: dict[str, Any]) -> None:
    """Reject metadata that a JSON column can't store or a response can't contain.

    Raises:
        Unprocessable: `invalid_field`.
        TooLarge: `fields_too_large`.
    """
    if _is_deeper_than(MAX_METADATA_DEPTH, value):
        raise invalid_field_error(
            "metadata", f"is nested more than {MAX_METADATA_DEPTH} levels deep"
        )
    try:
        text = json.dumps(value, ensure_ascii=False, allow_nan=False)
        text.encode()
    except UnicodeEncodeError:
        raise invalid_field_error("metadata", "contains an unpaired surrogate") from None
    except ValueError:
        raise invalid_field_error("metadata", "contains a number that is not finite") from None
    if len(text) > MAX_METADATA_CHARACTERS:
        raise TooLarge(
            "fields_too_large", f"metadata is longer than {MAX_METADATA_CHARACTERS} characters."
        )
    if JSON_NUL.search(text):
        raise invalid_field_error("metadata", "contains a NUL character")


def _reject_constant(name: str) -> Any:
    raise invalid_field_error("metadata", f"{name} is not JSON")


def _is_deeper_than(levels: int, value: Any) -> bool:
    """Return whether objects and lists are nested deeper than `levels`, without recursion."""
    stack = [(value, 1)]
    while stack:
        item, depth = stack.pop()
        if isinstance(item, dict | list):
            if depth > levels:
                return True
            children = item.values() if isinstance(item, dict) else item
            stack.extend((child, depth + 1) for child in children)
    return False


MAX_MANIFEST_BYTES = 32 * 1024 * 1024
NAME_COLUMNS = ("filename", "file", "path")
NUMBER_COLUMNS = ("latitude", "longitude", "altitude", "heading")
CSV_COLUMNS = (*NUMBER_COLUMNS, "captured_at", "place", "tags")
KEY_FIELD = "key"  # in a manifest of objects to import
FORMULA = re.compile("'*[=+@\\t\\r-]")  # such a cell is a formula in a spreadsheet, or was escaped
MAX_LINE_BYTES = 1_000_000  # of a manifest: metadata with each character escaped
MAX_REPORTED_LINES = 20  # bad lines in an error message
MAX_FAULT_CHARACTERS = 500


@dataclass(frozen=True, slots=True)
class ManifestEntry:
    """One line of a manifest: the metadata of one photo."""

    line: int
    name: str
    fields: dict[str, str]
    """Values by the names of the upload form, without empty ones."""


def escape_csv_text(text: str) -> str:
    """Put an apostrophe before text that a spreadsheet would run as a formula (`=`, `+`, `-`, `@`).

    `unescape_csv_text` returns the text again.
    """
    return f"'{text}" if FORMULA.match(text) else text


def unescape_csv_text(cell: str) -> str:
    """Remove the apostrophe of `escape_csv_text`."""
    return cell[1:] if cell.startswith("'") and FORMULA.match(cell) else cell


def read_csv_manifest(data: bytes, source_name: str) -> list[ManifestEntry]:
    """Parse a CSV table with a column of names (NAME_COLUMNS) and any of CSV_COLUMNS.

    Text may be as `escape_csv_text` writes it. Separators may be semicolons or tabs, with decimal
    commas, as spreadsheets write them. Errors name the table `source_name`.

    Raises:
        InvalidRequest: `bad_table`.
    """
    try:
        text = data.decode("utf-8-sig")
        separator = max(",;\t", key=text.partition("\n")[0].count)
        reader = csv.DictReader(io.StringIO(text, newline=""), delimiter=separator)
        if text[:4].lower() == "sep=":  # tells Excel the separator
            next(reader.reader)
        reader.fieldnames = columns = [name.strip().lower() for name in reader.fieldnames or []]
        name_column = next((c for c in NAME_COLUMNS if c in columns), None)
        if name_column is None:
            raise InvalidRequest(
                "bad_table",
                f"{source_name} has no column {' or '.join(NAME_COLUMNS)}. Its first line is "
                f"{','.join(columns) or 'empty'}; a complete header is "
                f"{','.join((NAME_COLUMNS[0], *CSV_COLUMNS))}. All columns but the first are "
                "optional.",
            )
        unknown = [c for c in columns if c not in (name_column, *CSV_COLUMNS)]
        if unknown:
            raise InvalidRequest(
                "bad_table",
                f"{source_name}: the columns {', '.join(unknown)} are unknown. Rename or remove "
                f"them; the known columns are {name_column}, {', '.join(CSV_COLUMNS)}.",
            )
        entries: list[ManifestEntry] = []
        seen: dict[str, int] = {}
        for row in filter(lambda row: any(row.values()), reader):  # spreadsheets add empty rows
            name = unescape_csv_text(row[name_column] or "")  # a short row has None
            fault = None
            if name in seen:
                fault = f"{name!r} is already in line {seen[name]}"
            elif None in row:
                fault = "has too many columns"
            elif any("\0" in cell for cell in row.values() if cell):
                fault = "contains a NUL character"
            if fault is not None:
                raise bad_lines_error("bad_table", source_name, [(reader.line_num, fault)])
            seen[name] = reader.line_num
            fields = {c: unescape_csv_text(row[c]) for c in CSV_COLUMNS if row.get(c)}
            if separator != ",":
                fields |= {c: fields[c].replace(",", ".") for c in NUMBER_COLUMNS if c in fields}
            entries.append(ManifestEntry(reader.line_num, name, fields))
        return entries
    except (UnicodeDecodeError, csv.Error) as error:
        raise InvalidRequest("bad_table", f"Can't read {source_name} as UTF-8: {error}") from error


def read_jsonl_manifest(
    data: bytes,
    source_name: str,
    name_fields: Sequence[str] = NAME_COLUMNS,
    max_entries: int | None = None,
) -> list[ManifestEntry]:
    """Parse a JSONL manifest: objects with a name and any of the upload form's fields.

    `tags` may be a list, `metadata` an object. Empty lines are skipped. Errors name the manifest
    `source_name`. Of a manifest with more than `max_entries`, one more than that are returned.

    Raises:
        InvalidRequest: `bad_manifest`, with the first MAX_REPORTED_LINES bad lines.
    """
    entries: list[ManifestEntry] = []
    bad: list[tuple[int, str]] = []
    seen: dict[str, int] = {}
    for number, line in _lines(data):
        try:
            entry = _parse_line(number, line, name_fields)
        except ValueError as error:
            bad.append((number, str(error)))
        else:
            if entry.name in seen:
                bad.append((number, f"{entry.name!r} is already in line {seen[entry.name]}"))
            seen.setdefault(entry.name, number)
            entries.append(entry)
        if len(bad) == MAX_REPORTED_LINES or len(entries) - 1 == max_entries:
            break
    if bad:
        raise bad_lines_error("bad_manifest", source_name, bad)
    return entries


def bad_lines_error(
    code: str, source_name: str, lines: Sequence[tuple[int, str]]
) -> PlacewiseError:
    """Return the error for bad lines of a manifest: (line number from 1, detail)."""
    lines = [(line, shorten(detail, MAX_FAULT_CHARACTERS)) for line, detail in lines]
    return InvalidRequest(
        code,
        "; ".join(f"{source_name}, line {line}: {detail}" for line, detail in lines) + ".",
        errors=[{"line": line, "detail": detail} for line, detail in lines],
    )


def _lines(data: bytes) -> Iterator[tuple[int, bytes]]:
    for number, line in enumerate(io.BytesIO(data.removeprefix(b"\xef\xbb\xbf")), start=1):
        if line.strip():
            yield number, line


def _parse_line(number: int, line: bytes, name_fields: Sequence[str]) -> ManifestEntry:
    """Parse one line; ValueError with the reason for a bad one."""
    if len(line) > MAX_LINE_BYTES:
        raise ValueError(f"has more than {MAX_LINE_BYTES} bytes")
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
        raise ValueError(f"{name_field} is not a non-empty string")
    _check_text(name_field, name)
    fields = {}
    for field, value in values.items():
        if field not in FORM_FIELDS:
            raise ValueError(f"{field} is unknown; the known fields are {', '.join(FORM_FIELDS)}")
        if value is not None:
            fields[field] = _as_form_text(field, value)
    return ManifestEntry(number, name, fields)


def _as_form_text(field: str, value: Any) -> str:
    """Convert a JSON value to the text of the upload form."""
    if isinstance(value, str):
        _check_text(field, value)
        return value
    if field == "metadata" and isinstance(value, dict):
        return json.dumps(value)
    if field == "tags" and isinstance(value, list):
        if not all(isinstance(tag, str) and "," not in tag for tag in value):
            raise ValueError("tags must be strings without commas")
        return _as_form_text(field, ",".join(value))
    if field in NUMBER_COLUMNS and type(value) in (int, float):
        return repr(value)
    raise ValueError(f"{field} can't be {json.dumps(value)[:50]}")


def _check_text(field: str, text: str) -> None:
    """Raise ValueError for text that the database can't store."""
    if "\0" in text:
        raise ValueError(f"{field} contains a NUL character")
    try:
        text.encode()
    except UnicodeEncodeError:
        raise ValueError(f"{field} contains an unpaired surrogate") from None
