"""The filters of both similarity calls and of the metadata search, read from the query."""

from __future__ import annotations

import math
from typing import Annotated
from uuid import UUID

from fastapi import Depends, Query

from shared.errors import invalid_field_error
from shared.intake.photo_fields import MAX_TEXT_CHARACTERS, parse_tags, parse_time
from shared.photo_filter import Box, Circle, PhotoFilter

TIME = "ISO 8601; no offset means UTC"
MAX_IDS = 1000
MAX_IDS_CHARACTERS = 40_000


def parse_photo_filter(
    near: Annotated[
        str | None, Query(description="LAT,LON,RADIUS_M: taken within so many metres of a point")
    ] = None,
    box: Annotated[
        str | None,
        Query(description="S,W,N,E in degrees; W greater than E crosses the antimeridian"),
    ] = None,
    captured_after: Annotated[
        str | None, Query(description="ISO 8601; no offset means UTC")
    ] = None,
    captured_before: Annotated[
        str | None, Query(description="ISO 8601; no offset means UTC")
    ] = None,
    place: Annotated[
        str | None, Query(max_length=MAX_TEXT_CHARACTERS, description="exactly this label")
    ] = None,
    tags: Annotated[
        str | None, Query(max_length=5000, description="separated by commas: all are wanted")
    ] = None,
    ids: Annotated[
        str | None,
        Query(max_length=MAX_IDS_CHARACTERS, description="separated by commas: only these photos"),
    ] = None,
) -> PhotoFilter:
    """The filter that the query parameters describe; 422 names the one that can't be read."""
    if place is not None and "\0" in place:
        raise invalid_field_error("place", "holds a NUL character")
    return PhotoFilter(
        near=_parse_circle(near) if near is not None else None,
        box=_parse_box(box) if box is not None else None,
        captured_after=parse_time("captured_after", captured_after) if captured_after else None,
        captured_before=parse_time("captured_before", captured_before) if captured_before else None,
        place=place or None,
        tags=tuple(parse_tags(tags.split(","))) if tags else (),
        ids=_parse_ids(ids) if ids is not None else None,
    )


FilterDep = Annotated[PhotoFilter, Depends(parse_photo_filter)]


def _parse_circle(text: str) -> Circle:
    latitude, longitude, radius_m = _parse_numbers("near", text, "LAT,LON,RADIUS_M")
    _check_coordinates("near", latitude, longitude)
    if radius_m < 0:
        raise invalid_field_error("near", f"its radius, {radius_m:g} m, is negative")
    return Circle(latitude=latitude, longitude=longitude, radius_m=radius_m)


def _parse_box(text: str) -> Box:
    south, west, north, east = _parse_numbers("box", text, "S,W,N,E")
    _check_coordinates("box", south, west)
    _check_coordinates("box", north, east)
    if south > north:
        raise invalid_field_error(
            "box", f"its south, {south:g}, lies north of its north, {north:g}"
        )
    return Box(south=south, west=west, north=north, east=east)


def _parse_numbers(field: str, text: str, form: str) -> list[float]:
    parts = text.split(",")
    try:
        numbers = [float(part) for part in parts]
    except ValueError:
        numbers = []
    if len(numbers) != len(form.split(",")) or not all(map(math.isfinite, numbers)):
        raise invalid_field_error(field, f"{text!r} is not {form}")
    return numbers


def _check_coordinates(field: str, latitude: float, longitude: float) -> None:
    if not -90 <= latitude <= 90:
        raise invalid_field_error(field, f"the latitude {latitude:g} is not between -90 and 90")
    if not -180 <= longitude <= 180:
        raise invalid_field_error(field, f"the longitude {longitude:g} is not between -180 and 180")


def _parse_ids(text: str) -> tuple[UUID, ...]:
    found = []
    for part in text.split(","):
        try:
            found.append(UUID(part.strip()))
        except ValueError:
            raise invalid_field_error("ids", f"{part.strip()!r} is no photo's id") from None
    if len(found) > MAX_IDS:
        raise invalid_field_error("ids", f"at most {MAX_IDS} ids")
    return tuple(found)
