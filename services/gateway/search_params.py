"""The filters of both similarity calls and of the metadata search, read from the query.

What of a ranking is asked for: the parameters that both similarity calls take.
"""

from __future__ import annotations

import math
from typing import Annotated
from uuid import UUID

from fastapi import Depends, Query
from pydantic import BaseModel, ConfigDict

from shared.errors import invalid_field_error
from shared.ingest.photo_metadata import MAX_TEXT_CHARACTERS, parse_tags, parse_time
from shared.search_api.comparison import MAX_RERANK_CANDIDATES
from shared.search_api.photo_filter import NO_FILTER, Box, Circle, PhotoFilter
from shared.search_api.protocol import Mode

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


class SearchParams(BaseModel):
    """What of the ranking is asked for. Kept with the job of a photo that is described first."""

    model_config = ConfigDict(frozen=True)

    top_k: int
    min_score: float | None = None
    photos: PhotoFilter = NO_FILTER
    word_weights: bool = True
    rerank: int | None = None
    explain: bool = False
    mode: Mode = Mode.AUTO
    most_rows: int | None = None
    most_seconds: float | None = None

    @property
    def needs_comparison(self) -> bool:
        """Whether an extractor has to look at what the search finds."""
        return self.rerank is not None or self.explain


TopK = Annotated[int, Query(ge=1, le=100, description="How many photos to answer.")]
MinScore = Annotated[
    float | None,
    Query(ge=-1, le=1, description="Leave out photos less similar than this."),
]
ModeParam = Annotated[
    Mode,
    Query(
        alias="mode",
        description="How to search: `auto`, whichever reads least; `dense`, every row; "
        "`deterministic`, leaving nothing to chance. The photos are the same.",
    ),
]
MaxRows = Annotated[
    int | None,
    Query(ge=0, description="End the search once so many rows were read, and say so."),
]
MaxSeconds = Annotated[
    float | None,
    Query(gt=0, description="End the search after so long, and say so."),
]
UseWordWeights = Annotated[
    bool,
    Query(
        alias="word_weights",
        description="Rank by the map's word weights, where it has any.",
    ),
]
Rerank = Annotated[
    int | None,
    Query(
        ge=1,
        le=MAX_RERANK_CANDIDATES,
        description="Look at the first N photos patch by patch, and order them by what is seen.",
    ),
]
Explain = Annotated[
    bool, Query(description="Say of each photo which clusters and patches make it similar.")
]


def parse_search_params(
    photos: FilterDep,
    top_k: TopK = 10,
    min_score: MinScore = None,
    word_weights: UseWordWeights = True,
    rerank: Rerank = None,
    explain: Explain = False,
    mode: ModeParam = Mode.AUTO,
    most_rows: MaxRows = None,
    most_seconds: MaxSeconds = None,
) -> SearchParams:
    return SearchParams(
        top_k=top_k,
        min_score=min_score,
        photos=photos,
        word_weights=word_weights,
        rerank=rerank,
        explain=explain,
        mode=mode,
        most_rows=most_rows,
        most_seconds=most_seconds,
    )


SearchParamsDep = Annotated[SearchParams, Depends(parse_search_params)]
