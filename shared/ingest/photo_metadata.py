"""What people say of a photo: read from form fields and JSON alike, each error naming its field.

Lists that say where many photos were taken: CSV tables and JSONL manifests.

Both give the upload form's fields by a photo's name. A list that can't be understood is refused
as a whole, and the refusal names its lines; a value that is wrong (a latitude of 95) is its photo's
own error, found when that photo comes in.
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

from shared.catalog.photos import PhotoRole
from shared.errors import InvalidRequest, PlacewiseError, TooLarge, invalid_field_error

MAX_TAGS = 50
MAX_METADATA_CHARACTERS = 100_000
MAX_METADATA_DEPTH = 32  # what writes answers gives up at 255 levels
MAX_TEXT_CHARACTERS = 500  # characters of a tag or a place

# A NUL as JSON writes it; after an escaped backslash the same letters are plain text.
JSON_NUL = re.compile(r"(?<!\\)(?:\\\\)*\\u0000")


@dataclass(frozen=True, slots=True)
class PhotoFields:
    """None means "not said"."""

    latitude: float | None = None
    longitude: float | None = None
    heading: float | None = None
    captured_at: datetime | None = None
    place: str | None = None
    tags: list[str] | None = None
    metadata: dict[str, Any] | None = None
    role: PhotoRole | None = None


FORM_FIELDS = tuple(PhotoFields.__slots__)


def read_form_fields(form: dict[str, str]) -> PhotoFields:
    """The form's text fields; an empty one counts as not said, an unknown one is refused."""
    for name in form:
        if name not in FORM_FIELDS:
            raise invalid_field_error(name, f"is unknown; known are {', '.join(FORM_FIELDS)}")
    said = {name: value.strip() for name, value in form.items() if value.strip()}
    fields = PhotoFields(
        latitude=_number(said, "latitude", -90, 90),
        longitude=_number(said, "longitude", -180, 180),
        heading=_heading(said),
        captured_at=parse_time("captured_at", said["captured_at"])
        if "captured_at" in said
        else None,
        place=_text("place", said["place"]) if "place" in said else None,
        tags=parse_tags(said["tags"].split(",")) if "tags" in said else None,
        metadata=_metadata(said["metadata"]) if "metadata" in said else None,
        role=_role(said["role"]) if "role" in said else None,
    )
    check_coordinate_pair(fields.latitude, fields.longitude)
    return fields


def check_coordinate_pair(latitude: float | None, longitude: float | None) -> None:
    """Coordinates come in pairs."""
    if (latitude is None) != (longitude is None):
        missing = "latitude" if latitude is None else "longitude"
        raise invalid_field_error(missing, "is missing: coordinates come in pairs")


def parse_time(field: str, text: str) -> datetime:
    """ISO 8601; a time without an offset is taken as UTC."""
    # In an address `+` means a blank, and few people write %2B.
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
    """Trimmed, without doubles, in the order given."""
    kept = list(dict.fromkeys(_text("tags", tag.strip()) for tag in tags if tag.strip()))
    if len(kept) > MAX_TAGS:
        raise invalid_field_error("tags", f"at most {MAX_TAGS} tags")
    return kept


def _number(said: dict[str, str], field: str, least: float, most: float) -> float | None:
    if field not in said:
        return None
    try:
        number = float(said[field])
    except ValueError:
        raise invalid_field_error(field, f"{said[field]!r} is not a number") from None
    if not math.isfinite(number) or not least <= number <= most:
        raise invalid_field_error(field, f"{said[field]} is not between {least:g} and {most:g}")
    return number


def _heading(said: dict[str, str]) -> float | None:
    heading = _number(said, "heading", 0, 360)
    return None if heading is None else heading % 360


def _text(field: str, text: str) -> str:
    if len(text) > MAX_TEXT_CHARACTERS:
        raise invalid_field_error(field, f"is longer than {MAX_TEXT_CHARACTERS} characters")
    if "\0" in text:
        raise invalid_field_error(field, "holds a NUL character")
    return text


def _role(text: str) -> PhotoRole:
    try:
        return PhotoRole(text)
    except ValueError:
        raise invalid_field_error(
            "role", f"{text!r} is not one of {', '.join(PhotoRole)}"
        ) from None


def _metadata(text: str) -> dict[str, Any]:
    refusal: PlacewiseError = invalid_field_error("metadata", "is not a JSON object")
    try:
        value = json.loads(text, parse_constant=_reject_constant)
    except (ValueError, RecursionError):
        raise refusal from None
    if not isinstance(value, dict):
        raise refusal
    check_metadata(value)
    return value


def check_metadata(value: dict[str, Any]) -> None:
    """Refuse what a JSON column can't hold, and what no answer could carry."""
    if _is_deeper_than(MAX_METADATA_DEPTH, value):
        raise invalid_field_error(
            "metadata", f"is nested more than {MAX_METADATA_DEPTH} levels deep"
        )
    try:
        text = json.dumps(value, ensure_ascii=False, allow_nan=False)
        text.encode()
    except UnicodeEncodeError:
        raise invalid_field_error("metadata", "holds half of a surrogate pair") from None
    except ValueError:
        raise invalid_field_error("metadata", "holds a number that is not finite") from None
    if len(text) > MAX_METADATA_CHARACTERS:
        raise TooLarge(
            "fields_too_large", f"metadata is longer than {MAX_METADATA_CHARACTERS} characters."
        )
    if JSON_NUL.search(text):
        raise invalid_field_error("metadata", "holds a NUL character")


def _reject_constant(name: str) -> Any:
    raise invalid_field_error("metadata", f"{name} is not JSON")


def _is_deeper_than(levels: int, value: Any) -> bool:
    """Are more than `levels` objects and lists nested in each other? Asked without recursion."""
    left = [(value, 1)]
    while left:
        item, depth = left.pop()
        if isinstance(item, dict | list):
            if depth > levels:
                return True
            children = item.values() if isinstance(item, dict) else item
            left.extend((child, depth + 1) for child in children)
    return False


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
