"""Responses about reconstructions, and the positions that are proposed for photos."""

from __future__ import annotations

from datetime import datetime, timedelta
from typing import Any
from uuid import UUID

from pydantic import AwareDatetime, Field

from shared.responses import ResponseModel
from shared.responses.similarity import PhotoResponse, SimilarPhotoResponse


class ComponentResponse(ResponseModel):
    """Photos that were reconstructed together, in a frame of their own."""

    number: int
    photos: int
    points: int
    mean_reprojection_error_pixels: float = Field(
        description="of photos whose longer side has 640 pixels"
    )
    latitude: float | None = Field(
        description="of the middle of its photos; null if it is not aligned"
    )
    longitude: float | None
    altitude_m: float | None = Field(description="null also if its photos have no altitudes")
    metres_per_unit: float | None = Field(description="metres in a unit of its frame")
    alignment_rms_m: float | None = Field(
        description="root mean square distance between the photos that agree and their coordinates"
    )
    agreeing: int | None = Field(description="photos that agree with their coordinates")
    located: int | None = Field(description="photos that have coordinates")
    is_on_line: bool | None = Field(
        description="whether its photos are on a line: upright cameras settle the turn about it"
    )
    not_aligned: str | None = Field(description="why it is not aligned")
    calibration: dict[str, Any] | None = Field(
        description="errors of the poses of its own photos, each localised without itself, in "
        "standard deviations (`position_68`, `position_95`, `heading_68`, `heading_95`), the share "
        "that was found (`share_found`), and the number of `poses` that this rests on; "
        "`known_lens` has the same of queries by the cameras of the map"
    )


class ReconstructionResponse(ResponseModel):
    reconstruction_id: UUID = Field(validation_alias="id")
    job_id: UUID
    generation_id: UUID
    map_version: int = Field(description="version of the map when its photos were read")
    features_model: str = Field(description="model of the local features that it is made of")
    imported: bool = Field(description="whether its poses come from an imported COLMAP model")
    components: list[ComponentResponse] = Field(description="largest first")
    proposals: int = Field(
        description="number of photos whose coordinates disagree with it, without accepted ones: "
        "`GET /reconstructions/{reconstruction_id}/proposals`"
    )
    created_at: datetime
    finished_at: datetime


class CoordinateProposalResponse(ResponseModel):
    """A photo whose coordinates disagree with the reconstruction."""

    image_id: UUID
    original_filename: str
    relative_path: str | None
    latitude: float = Field(description="when it was reconstructed")
    longitude: float
    proposed_latitude: float
    proposed_longitude: float
    distance_m: float = Field(description="between both")
    radius_95_m: float = Field(description="that contains the true place with 95 %")
    accepted: bool = Field(description="whether the photo has the proposed coordinates now")


class PhotoHeaderResponse(ResponseModel):
    """What a photo's header says about when, where and by which camera it was taken."""

    captured_at: AwareDatetime | None = Field(
        description="UTC; if `time_zone_is_known` is false, the camera's clock as if it were UTC"
    )
    time_zone_is_known: bool
    camera: str | None = Field(description="make, model, owner and serial number")
    camera_is_unique: bool = Field(description="`camera` contains a serial number or an owner")
    clock_offset: timedelta | None = Field(
        description="of the camera's clock from UTC, by its tag or the GPS time"
    )
    latitude: float | None
    longitude: float | None
    gps_error: str | None = Field(
        description="why the photo may have coordinates although none are known: a tag that is not "
        "understood, or metadata behind the bytes that were sent; propose none for it"
    )
    focal_length: float | None = Field(description="as a multiple of the photo's longer side")


class ProposalResponse(ResponseModel):
    """Where a photo was probably taken."""

    name: str
    latitude: float | None = Field(None, description="null if nothing is known about its place")
    longitude: float | None = None
    radius_m: float
    probability: float = Field(description="that it was taken within `radius_m`")
    radius_68_m: float | None = None
    heading: float | None = Field(
        None, description="degrees clockwise from north; null unless the proposal rests on a pose"
    )
    reason: str


class StoredProposalResponse(ProposalResponse):
    """Where a photo of the map was probably taken that has no place."""

    photo: PhotoResponse
    place: str | None = Field(None, description="label, in a map of labels")
    place_probability: float | None = None
    looks_like: SimilarPhotoResponse | None = Field(
        description="the most similar photo that has a place within `radius_m` of the proposal, "
        "or its label"
    )
    error: str | None = Field(None, description="why the photo could not be searched with")


class PlaceProposalsResponse(ResponseModel):
    total: int = Field(description="number of photos without a place, not only of this page")
    proposals: list[StoredProposalResponse] = Field(description="newest upload first")
    next_cursor: str | None


class GivenPlacesResponse(ResponseModel):
    given: list[UUID]
    skipped: dict[UUID, str] = Field(description="reasons by photo: it has a place meanwhile")


class UndonePlacesResponse(ResponseModel):
    restored: list[UUID] = Field(description="have the former values again")
    changed_since: list[UUID] = Field(description="got another place since; left as they are")
