"""Photo filters as expressions of Milvus, and the columns that they read.

Labels are stored as the hexadecimal digits of their UTF-8 bytes: no label needs quoting, none has a
wildcard, and their order is that of the bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from datetime import UTC, datetime, timedelta
from decimal import Decimal
from typing import Any
from uuid import UUID

from shared.catalog.photos import PhotoFilterValues
from shared.place_paths import PATH_SEPARATOR
from shared.search_api.photo_filter import Box, PhotoFilter

EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
NO_TIME = -(10**18)  # before the first year that a datetime has
NO_DEGREES = 1000.0
FINDABLE = "findable == true"
LABEL = "="
"""Begins a stored place, so that one without characters differs from none"""


def filter_columns(photo: PhotoFilterValues) -> dict[str, Any]:
    """Return a photo's filterable values as columns of its row in Milvus."""
    return {
        "photo": photo.photo_id.hex,
        "findable": photo.findable,
        "latitude": NO_DEGREES if photo.latitude is None else photo.latitude,
        "longitude": NO_DEGREES if photo.longitude is None else photo.longitude,
        "captured_at": NO_TIME if photo.captured_at is None else _microseconds(photo.captured_at),
        "place": "" if photo.place is None else LABEL + _hex(photo.place),
        "tags": [_hex(tag) for tag in photo.tags],
    }


def filter_expression(
    photo_filter: PhotoFilter,
    exclude: Collection[UUID],
    tags_with: Callable[[str], Iterable[str]],
) -> str:
    """Return the expression for findable photos that pass the filter and are not excluded.

    A circle becomes its bounding box: the caller compares the distances of what is found.

    Args:
        tags_with: Returns the tags of the map of which a text is a part.
    """
    conditions = [FINDABLE]
    if photo_filter.ids is not None:
        conditions.append(f"photo in {_texts(id_.hex for id_ in photo_filter.ids)}")
    if exclude:
        conditions.append(f"photo not in {_texts(id_.hex for id_ in exclude)}")
    if photo_filter.has_place:
        conditions.append(f'(latitude < {NO_DEGREES} or place != "")')
    if photo_filter.place is not None:
        conditions.append(f'place == "{LABEL}{_hex(photo_filter.place)}"')
    if photo_filter.place_under is not None:
        level = LABEL + _hex(photo_filter.place_under)
        below = f"{level}{_hex(PATH_SEPARATOR)}%"
        conditions.append(f'(place == "{level}" or place like "{below}")')
    conditions += [f'array_contains(tags, "{_hex(tag)}")' for tag in photo_filter.tags]
    for part in photo_filter.tags_like:
        like = _texts(map(_hex, tags_with(part)))
        # Milvus refuses to look for one of no tags.
        conditions.append(f"array_contains_any(tags, {like})" if like != "[]" else "photo in []")
    if photo_filter.captured_after is not None:
        conditions.append(f"captured_at >= {_microseconds(photo_filter.captured_after)}")
    if photo_filter.captured_before is not None:
        before = _microseconds(photo_filter.captured_before)
        conditions.append(f"(captured_at > {NO_TIME} and captured_at <= {before})")
    if photo_filter.box is not None:
        conditions.append(_in_box(photo_filter.box))
    if photo_filter.near is not None:
        conditions.append(_in_box(photo_filter.near.bounding_box()))
    return " and ".join(conditions)


def _in_box(box: Box) -> str:
    latitude = f"latitude >= {_number(box.south)} and latitude <= {_number(box.north)}"
    ranges = [
        f"(longitude >= {_number(west)} and longitude <= {_number(east)})"
        for west, east in box.longitude_ranges()
    ]
    return f"({latitude} and ({' or '.join(['latitude in [90.0, -90.0]', *ranges])}))"


def _number(value: float) -> str:
    """All digits of the number, without an exponent."""
    digits = format(Decimal(value), "f")
    return digits if "." in digits else f"{digits}.0"


def _texts(texts: Iterable[str]) -> str:
    return "[" + ", ".join(f'"{text}"' for text in texts) + "]"


def _hex(text: str) -> str:
    return text.encode().hex()


def _microseconds(when: datetime) -> int:
    return (when - EPOCH) // timedelta(microseconds=1)
