"""Query parameters of the searches: photo filters and the ranking parameters.

`FilterDep` parses the filters of the similarity searches and of the metadata search;
`SearchParamsDep` adds the ranking parameters of the similarity searches.
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
        str | None,
        Query(description="LAT,LON,RADIUS_M: photos taken within RADIUS_M metres of the point"),
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
        str | None,
        Query(max_length=MAX_TEXT_CHARACTERS, description="photos with exactly this label"),
    ] = None,
    place_under: Annotated[
        str | None,
        Query(
            max_length=MAX_TEXT_CHARACTERS,
            description="photos whose label is this level or lies below it; only for maps with "
            "`place_labels_are_paths`",
        ),
    ] = None,
    tags: Annotated[
        str | None, Query(max_length=5000, description="separated by commas; photos must have all")
    ] = None,
    ids: Annotated[
        str | None,
        Query(max_length=MAX_IDS_CHARACTERS, description="photo ids, separated by commas"),
    ] = None,
) -> PhotoFilter:
    """Parses the filter from the query parameters.

    Raises:
        Unprocessable: `invalid_field`, with the name of the invalid parameter.
    """
    if place is not None and "\0" in place:
        raise invalid_field_error("place", "contains a NUL character")
    if place_under is not None and ("\0" in place_under or not place_under.strip("/ ")):
        raise invalid_field_error("place_under", "names no level of a path")
    return PhotoFilter(
        near=_parse_circle(near) if near is not None else None,
        box=_parse_box(box) if box is not None else None,
        captured_after=parse_time("captured_after", captured_after) if captured_after else None,
        captured_before=parse_time("captured_before", captured_before) if captured_before else None,
        place=place or None,
        place_under=place_under.rstrip("/") if place_under is not None else None,
        tags=tuple(parse_tags(tags.split(","))) if tags else (),
        ids=_parse_ids(ids) if ids is not None else None,
    )


def check_place_filter(photo_filter: PhotoFilter, labels_are_paths: bool) -> None:
    """Checks that the map has the levels that the filter names.

    Raises:
        Unprocessable: `invalid_field`, for `place_under` in a map whose labels are no paths.
    """
    if photo_filter.place_under is not None and not labels_are_paths:
        raise invalid_field_error(
            "place_under",
            "needs a map whose place labels are paths: PATCH /api/v1/maps/{name} with "
            "`place_labels_are_paths`",
        )


FilterDep = Annotated[PhotoFilter, Depends(parse_photo_filter)]


def _parse_circle(text: str) -> Circle:
    latitude, longitude, radius_m = _parse_numbers("near", text, "LAT,LON,RADIUS_M")
    _check_coordinates("near", latitude, longitude)
    if radius_m < 0:
        raise invalid_field_error("near", f"the radius {radius_m:g} m is negative")
    return Circle(latitude=latitude, longitude=longitude, radius_m=radius_m)


def _parse_box(text: str) -> Box:
    south, west, north, east = _parse_numbers("box", text, "S,W,N,E")
    _check_coordinates("box", south, west)
    _check_coordinates("box", north, east)
    if south > north:
        raise invalid_field_error(
            "box", f"the southern latitude {south:g} is greater than the northern {north:g}"
        )
    return Box(south=south, west=west, north=north, east=east)


def _parse_numbers(field: str, text: str, form: str) -> list[float]:
    parts = text.split(",")
    try:
        numbers = [float(part) for part in parts]
    except ValueError:
        numbers = []
    if len(numbers) != len(form.split(",")) or not all(map(math.isfinite, numbers)):
        raise invalid_field_error(field, f"{text!r} does not have the form {form}")
    return numbers


def _check_coordinates(field: str, latitude: float, longitude: float) -> None:
    if not -90 <= latitude <= 90:
        raise invalid_field_error(field, f"the latitude {latitude:g} is not between -90 and 90")
    if not -180 <= longitude <= 180:
        raise invalid_field_error(field, f"the longitude {longitude:g} is not between -180 and 180")


def _parse_ids(text: str) -> tuple[UUID, ...]:
    ids = []
    for part in text.split(","):
        try:
            ids.append(UUID(part.strip()))
        except ValueError:
            raise invalid_field_error("ids", f"{part.strip()!r} is not a photo id (UUID)") from None
    if len(ids) > MAX_IDS:
        raise invalid_field_error("ids", f"has {len(ids)} ids; at most {MAX_IDS} are allowed")
    return tuple(ids)


class SearchParams(BaseModel):
    """Parameters of a similarity search.

    Stored as JSON in the job of a query photo, which is described before the search runs.
    """

    model_config = ConfigDict(frozen=True)

    top_k: int
    min_score: float | None = None
    photos: PhotoFilter = NO_FILTER
    word_weights: bool = True
    rerank: int | None = None
    explain: bool = False
    certainty: float | None = None
    mode: Mode = Mode.AUTO
    most_rows: int | None = None
    most_seconds: float | None = None

    @property
    def needs_comparison(self) -> bool:
        """Whether an extractor must compare the query with the found photos."""
        return self.rerank is not None or self.explain


TopK = Annotated[int, Query(ge=1, le=100, description="Maximum number of photos to return.")]
MinScore = Annotated[
    float | None,
    Query(ge=-1, le=1, description="Minimum cosine similarity of the returned photos."),
]
ModeParam = Annotated[
    Mode,
    Query(
        alias="mode",
        description="Search algorithm. `auto`: the one that reads the fewest rows; `dense`: scans "
        "every row; `deterministic`: uses no probabilistic bounds. All return the same photos.",
    ),
]
MaxRows = Annotated[
    int | None,
    Query(
        ge=0, description="Stop the search after reading this many rows; `certificate` reports it."
    ),
]
MaxSeconds = Annotated[
    float | None,
    Query(gt=0, description="Stop the search after this many seconds; `certificate` reports it."),
]
UseWordWeights = Annotated[
    bool,
    Query(
        alias="word_weights",
        description="Rank by the word weights of the map, if it has any.",
    ),
]
Rerank = Annotated[
    int | None,
    Query(
        ge=1,
        le=MAX_RERANK_CANDIDATES,
        description="Compare the first N photos with the query patch by patch, and rerank them.",
    ),
]
Explain = Annotated[
    bool,
    Query(description="Return the clusters and patches that contribute to each similarity."),
]


Certainty = Annotated[
    float | None,
    Query(
        gt=0,
        le=1,
        description="Share of the answers that must be right: the estimate answers at the finest "
        "level that is certain enough. Default: CERTAINTY.",
    ),
]


def parse_search_params(
    photos: FilterDep,
    top_k: TopK = 10,
    min_score: MinScore = None,
    word_weights: UseWordWeights = True,
    rerank: Rerank = None,
    explain: Explain = False,
    certainty: Certainty = None,
    mode: ModeParam = Mode.AUTO,
    most_rows: MaxRows = None,
    most_seconds: MaxSeconds = None,
) -> SearchParams:
    """Dependency that collects the query parameters of a similarity search."""
    return SearchParams(
        top_k=top_k,
        min_score=min_score,
        photos=photos,
        word_weights=word_weights,
        rerank=rerank,
        explain=explain,
        certainty=certainty,
        mode=mode,
        most_rows=most_rows,
        most_seconds=most_seconds,
    )


SearchParamsDep = Annotated[SearchParams, Depends(parse_search_params)]
