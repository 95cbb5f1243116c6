"""Routes that propose positions for photos without coordinates; they store nothing."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import asdict
from datetime import timedelta
from typing import Annotated, Any, Literal, Self

from fastapi import APIRouter, Body
from pydantic import AwareDatetime, ConfigDict, Field, model_validator

from services.gateway.authentication import READ
from services.gateway.dependencies import NO_PARAMETERS, GatewayDep, MapQuery
from shared.catalog.chunks import count_searchable
from shared.catalog.generations import active_generation
from shared.catalog.maps import get_map
from shared.geotagging.evidence import (
    DatedPhoto,
    KnownPosition,
    PictureEvidence,
    PosePosition,
    ProbableCircle,
    SimilarPosition,
    TimeNeighbours,
    add_time_zones,
)
from shared.geotagging.fusion import Proposal
from shared.geotagging.locate import PositionFinder
from shared.http.request_model import FailFastList, RequestModel
from shared.imaging.capture_place import is_null_island
from shared.imaging.photo_header import read_photo_header
from shared.ingest.photo_metadata import coordinate_pair
from shared.responses import ResponseModel
from shared.responses.reconstructions import PhotoHeaderResponse, ProposalResponse
from shared.tracks.motion import motion_model

router = APIRouter(tags=["photos"])

MAX_NAME = 1000
MAX_UNLOCATED = 100
"""Photos without coordinates in one call; each takes some milliseconds"""
MAX_SIMILAR = 100
POSITIONS_PATH = "/positions"
MAX_BODY_BYTES = 4_000_000
"""Of a folder with 10,000 photos, a track, and 100 photos to locate with 50 similar ones each"""

Latitude = Annotated[float, Field(ge=-90, le=90)]
Longitude = Annotated[float, Field(ge=-180, le=180)]
Probability = Annotated[float, Field(ge=0, le=1)]
Name = Annotated[str, Field(max_length=MAX_NAME)]
ClockOffset = Annotated[timedelta, Field(ge=timedelta(days=-1), le=timedelta(days=1))]


class FiniteModel(RequestModel):
    """A body whose numbers are finite."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class SimilarBody(FiniteModel):
    """A photo of the map that looks similar."""

    name: Name
    latitude: Latitude
    longitude: Longitude
    score: float = Field(ge=-10, le=10)


class CircleBody(FiniteModel):
    """A level of the estimate."""

    latitude: Latitude
    longitude: Longitude
    radius_m: float = Field(ge=0.001, le=1e6)
    probability: Probability


class PoseBody(FiniteModel):
    """The pose that a search found, if it has coordinates."""

    latitude: Latitude
    longitude: Longitude
    radius_68_m: float = Field(ge=0.001, le=1e6)
    heading: float = Field(ge=0, le=360)


class SearchBody(FiniteModel):
    """What a similarity search answered for the photo."""

    similar: list[SimilarBody] = Field(max_length=MAX_SIMILAR, description="best first")
    circles: list[CircleBody] = Field(max_length=10, description="finest first")
    not_in_map: Probability
    pose: PoseBody | None = None
    headline: str = Field("", max_length=MAX_NAME, description="of the estimate")


class DatedPhotoBody(FiniteModel):
    """A photo of a folder, with or without coordinates."""

    name: Name
    captured_at: AwareDatetime | None = None
    time_zone_is_known: bool = False
    camera: Name | None = None
    camera_is_unique: bool = False
    clock_offset: ClockOffset | None = None
    latitude: Latitude | None = None
    longitude: Longitude | None = None
    search: SearchBody | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.latitude is None) != (self.longitude is None):
            raise ValueError("send both `latitude` and `longitude`, or neither")
        return self

    def coordinates(self) -> tuple[float | None, float | None]:
        """Return latitude and longitude; 0, 0 are none."""
        return coordinate_pair(self.latitude, self.longitude)


class TrackPointBody(FiniteModel):
    time: AwareDatetime
    latitude: Latitude
    longitude: Longitude


class ProposalOptions(FiniteModel):
    """What is known beside the photos."""

    track: FailFastList[TrackPointBody] = Field(
        default=[], max_length=10_000, description="points of a GPX track"
    )
    radius_m: float = Field(100.0, ge=10, le=2000, description="radius of the proposals")
    motion: Literal["walk", "bicycle", "car", "train"] = "walk"
    together: bool = Field(
        False, description="photos of all cameras are neighbours in time, not only of the same one"
    )

    def finder(self, photos: Sequence[DatedPhoto]) -> PositionFinder:
        """Return what locates photos among others."""
        points = [
            KnownPosition(each.time, each.latitude, each.longitude)
            for each in self.track
            if not is_null_island(each.latitude, each.longitude)
        ]
        points.sort(key=lambda point: point.time)
        neighbours = TimeNeighbours(photos, self.together)
        return PositionFinder(neighbours, points, motion_model(self.motion), self.radius_m)


class PositionsBody(ProposalOptions):
    """The photos of a folder."""

    photos: FailFastList[DatedPhotoBody] = Field(
        max_length=10_000,
        description=f"at most {MAX_UNLOCATED} of them without coordinates; the others show where "
        "their camera was",
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if sum(photo.latitude is None for photo in self.photos) > MAX_UNLOCATED:
            raise ValueError(f"send at most {MAX_UNLOCATED} photos without coordinates")
        return self


class ProposalsResponse(ResponseModel):
    proposals: list[ProposalResponse] = Field(
        description="of the photos without coordinates, in their order"
    )


@router.post("/photo-headers", operation_id="read_photo_header", dependencies=[READ, NO_PARAMETERS])
def read_header(
    gateway: GatewayDep,
    begin: Annotated[
        bytes, Body(media_type="application/octet-stream", description="first bytes of the photo")
    ],
) -> PhotoHeaderResponse:
    """Read time, camera and coordinates from the first bytes of a photo.

    256 KiB are enough for most; send the whole file if they can't be read, or with `gps_error`.
    """
    header = read_photo_header(io.BytesIO(begin), gateway.settings.max_image_pixels)
    return PhotoHeaderResponse.model_validate(header)


@router.post(POSITIONS_PATH, dependencies=[READ])
def propose_positions(
    gateway: GatewayDep, query: MapQuery, body: PositionsBody
) -> ProposalsResponse:
    """Propose where photos were taken that have no coordinates.

    The answers of similarity searches are combined with photos that have coordinates and were taken
    shortly before or after, and with a GPX track. Nothing is stored.
    """
    with gateway.catalog.read() as session:
        generation = active_generation(session, get_map(session, query.map).id)
        photo_count = count_searchable(session, generation.id) if generation else 0
    photos = [
        DatedPhoto(
            each.name,
            each.captured_at,
            each.time_zone_is_known,
            each.camera,
            *each.coordinates(),
            each.clock_offset,
            each.camera_is_unique,
        )
        for each in body.photos
    ]
    photos = add_time_zones(photos)
    finder = body.finder(photos)
    proposals = []
    for photo, sent in zip(photos, body.photos, strict=True):
        if photo.latitude is not None:
            continue
        picture = _picture_evidence(sent.search, photo_count)
        proposal, reason = finder.propose(photo, picture)
        proposals.append(
            ProposalResponse(**proposal_fields(photo.name, proposal, reason, body.radius_m))
        )
    return ProposalsResponse(proposals=proposals)


def proposal_fields(
    name: str, proposal: Proposal | None, reason: str, radius_m: float
) -> dict[str, Any]:
    """Return the fields of a `ProposalResponse`."""
    if proposal is None:
        return {"name": name, "radius_m": radius_m, "probability": 0.0, "reason": reason}
    return {"name": name, **asdict(proposal)}


def _picture_evidence(search: SearchBody | None, photo_count: int) -> PictureEvidence | None:
    if search is None:
        return None
    return PictureEvidence(
        [SimilarPosition(**each.model_dump()) for each in search.similar],
        [ProbableCircle(**each.model_dump()) for each in search.circles],
        search.not_in_map,
        photo_count,
        PosePosition(**search.pose.model_dump()) if search.pose else None,
        search.headline,
    )
