"""What people say of a photo: read from form fields and JSON alike, each error naming its field."""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from shared.catalog.photos import PhotoRole
from shared.errors import PlacewiseError, TooLarge, invalid_field_error

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
