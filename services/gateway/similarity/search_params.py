"""Query parameters of the searches: photo filters and the ranking parameters.

`FilterParams` are those of the similarity searches and of the metadata search; `SimilarityParams`
adds the ranking parameters of the similarity searches.
"""

from __future__ import annotations

import math
from datetime import datetime
from uuid import UUID

from pydantic import BaseModel, ConfigDict, Field

from services.gateway.dependencies import MapParams
from shared.errors import invalid_field_error
from shared.geometry.colmap_model import ColmapCamera
from shared.ingest.photo_metadata import MAX_TEXT_CHARACTERS, parse_tags, parse_time
from shared.search_api.photo_filter import NO_FILTER, Box, Circle, PhotoFilter
from shared.search_api.protocol import MAX_MATCHED_PHOTOS

TIME = "ISO 8601; no offset means UTC"
DEFAULT_MATCHES = 10
MAX_IDS = 1000
MAX_IDS_CHARACTERS = 40_000


class FilterParams(MapParams):
    """Query parameters that filter photos."""

    near: str | None = Field(
        None, description="LAT,LON,RADIUS_M: photos taken within RADIUS_M metres of the point"
    )
    box: str | None = Field(
        None, description="S,W,N,E in degrees; W greater than E crosses the antimeridian"
    )
    captured_after: str | None = Field(None, description=TIME)
    captured_before: str | None = Field(None, description=TIME)
    place: str | None = Field(
        None, max_length=MAX_TEXT_CHARACTERS, description="photos with exactly this label"
    )
    place_under: str | None = Field(
        None,
        max_length=MAX_TEXT_CHARACTERS,
        description="photos whose label is this level of a path, or lies below it",
    )
    tags: str | None = Field(
        None, max_length=5000, description="separated by commas; photos must have all"
    )
    tags_like: str | None = Field(
        None,
        max_length=5000,
        description="separated by commas; each must be a part of one of the photo's tags, "
        "case-insensitive for A to Z",
    )
    ids: str | None = Field(
        None, max_length=MAX_IDS_CHARACTERS, description="photo ids, separated by commas"
    )

    def photo_filter(self) -> PhotoFilter:
        """Parse the filter.

        Raises:
            Unprocessable: `invalid_field`, with the name of the invalid parameter.
        """
        if self.place is not None and "\0" in self.place:
            raise invalid_field_error("place", "contains a NUL character")
        level = self.place_under
        if level is not None and ("\0" in level or not level.strip("/ ")):
            raise invalid_field_error("place_under", "names no level of a path")
        return PhotoFilter(
            near=_parse_circle(self.near) if self.near is not None else None,
            box=_parse_box(self.box) if self.box is not None else None,
            captured_after=parse_optional_time("captured_after", self.captured_after),
            captured_before=parse_optional_time("captured_before", self.captured_before),
            place=self.place or None,
            place_under=level.rstrip("/") if level is not None else None,
            tags=tuple(parse_tags(self.tags.split(","))) if self.tags else (),
            tags_like=tuple(parse_tags(self.tags_like.split(","))) if self.tags_like else (),
            ids=_parse_ids(self.ids) if self.ids is not None else None,
        )


def parse_optional_time(field: str, text: str | None) -> datetime | None:
    """Parse a time; None if it is omitted or empty."""
    return parse_time(field, text) if text else None


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


class RankingParams(BaseModel):
    """Number of results of a similarity search, ranking, and limits of its cost."""

    model_config = ConfigDict(frozen=True)

    top_k: int = Field(10, ge=1, le=100, description="Maximum number of photos to return.")
    min_score: float | None = Field(
        None, ge=-1, le=1, description="Minimum cosine similarity of the returned photos."
    )
    matches: int | None = Field(
        None,
        ge=0,
        le=MAX_MATCHED_PHOTOS,
        description="Match the local features of the first N photos with the query's. Default: 10 "
        "if estimates of the map use matches, and with `explain`; 0 otherwise.",
    )
    rerank: int | None = Field(
        None,
        ge=1,
        le=MAX_MATCHED_PHOTOS,
        description="Match the first N photos, and order them by the number of matching points.",
    )
    explain: bool = Field(
        False, description="Return the matching points of each photo that was matched."
    )
    pose: bool = Field(
        False,
        description="Compute where the camera stood and looked. Takes a reconstruction of the map; "
        "otherwise `no_pose` says what is missing.",
    )
    focal_length: float | None = Field(
        None,
        ge=0.1,
        le=100,
        description="Focal length of the query's camera in pixels, divided by the photo's longer "
        "side. Default: that of the EXIF, or else it is estimated.",
    )
    elsewhere: float | None = Field(
        None,
        gt=0,
        lt=1,
        description="Share of your queries that are from elsewhere. Default: the map's.",
    )
    certainty: float | None = Field(
        None,
        gt=0,
        le=1,
        description="Share of the answers that must be right: the estimate answers at the finest "
        "level that is certain enough. Default: CERTAINTY.",
    )
    guarantee: float | None = Field(
        None,
        gt=0,
        lt=1,
        description="Share of all queries that may get a wrong answer, instead of `certainty`. "
        "Holds for queries like the map's labelled ones, of which it takes 40 or more "
        "(1 / guarantee - 1).",
    )
    history: bool = Field(
        True,
        description="Add the search to the search history. `false` for programs that search with "
        "many photos.",
    )

    def photos_to_match(self, by_default: bool) -> int:
        """Return how many photos to match; `by_default`: also if the request names no number."""
        default = DEFAULT_MATCHES if by_default or self.explain else 0
        return max(default if self.matches is None else self.matches, self.rerank or 0)


class SearchParams(RankingParams):
    """Parameters of a similarity search.

    Stored as JSON in the job of a query photo, which is described before the search runs.
    """

    photos: PhotoFilter = NO_FILTER
    hint: Circle | None = None
    """where the pose may be: photos there are tried first"""
    camera: ColmapCamera | None = None
    """that took the query"""


class SimilarityParams(RankingParams, FilterParams):
    """Query parameters of the similarity searches."""

    def search_params(self) -> SearchParams:
        """Parse the filter; raises as `photo_filter`."""
        ranking = self.model_dump(include=set(RankingParams.model_fields))
        return SearchParams(photos=self.photo_filter(), **ranking)
