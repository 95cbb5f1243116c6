"""Responses about tracks."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal
from uuid import UUID

from pydantic import Field

from shared.responses import OPEN, ResponseModel
from shared.responses.similarity import EstimateLevelResponse


class TrackStateResponse(ResponseModel):
    """Where the camera of a track is."""

    status: Annotated[Literal["converging", "tracking", "lost"], OPEN] = Field(
        description="`tracking`: the position or place is probable; `lost`: it was, or the camera "
        "is probably outside the map; `converging`: not yet"
    )
    image_id: UUID | None = Field(description="the nearest photo of the map; null if unknown")
    latitude: float | None
    longitude: float | None
    place: str | None
    heading: float | None = Field(
        description="degrees clockwise from north: of the frame's pose, or else of the nearest "
        "photo; null if the map has none"
    )
    probability: float = Field(description="that the camera is at the finest level")
    levels: list[EstimateLevelResponse] = Field(
        description="finest first, as in the estimate of a single photo"
    )
    radius_68_m: float | None = Field(
        description="radius in metres around the position that contains the true one with a "
        "probability of 68 %; null without coordinates, or if it exceeds the largest level"
    )
    radius_95_m: float | None = Field(description="the same with 95 %")
    not_in_map_probability: float = Field(description="that the camera is outside the map")


class TrackResponse(ResponseModel):
    """A track with its last state."""

    track_id: UUID
    motion: str | None
    max_speed_mps: float | None
    version: int = Field(
        description="number of accepted frames; a frame with this `expected_version` is accepted "
        "only if no other client has added one"
    )
    pending: int = Field(description="accepted frames that are not applied yet")
    state: TrackStateResponse | None = Field(description="after the last applied frame")
    created_at: datetime
    updated_at: datetime = Field(description="when the last frame was accepted")
    expires_at: datetime = Field(description="the track is deleted then, unless a frame is added")


class TrackFrameResponse(ResponseModel):
    """A frame of a track."""

    frame_id: UUID
    captured_at: datetime
    filename: str
    status: Annotated[Literal["pending", "applied", "failed"], OPEN] = Field(
        description="`pending` until the photo is described and all earlier frames are applied; "
        "`failed`: the photo could not be described, and the track continues without it"
    )
    state: TrackStateResponse | None = Field(
        description="the state of the track after this frame; frames that arrive late change it"
    )
    error: dict[str, Any] | None = Field(description="an RFC 9457 problem")
    job_id: UUID
    job_url: str
    frame_url: str
    version: int = Field(description="of the track when the frame was accepted")


class TrackDetailResponse(TrackResponse):
    """A track with all frames, in the order of their times."""

    smoothed: bool
    frames: list[TrackFrameResponse]


class DeletedTrackResponse(ResponseModel):
    success: bool
    message: str
    deleted_track_id: UUID
