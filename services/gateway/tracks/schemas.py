"""Schemas of tracks: how one begins, the form fields of a frame, and the state after a frame."""

from __future__ import annotations

from datetime import datetime
from functools import partial
from typing import Annotated, Any, Literal, Self
from uuid import UUID

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from shared.geodesy import distance_m
from shared.http.request_model import RequestModel
from shared.ingest.photo_metadata import coordinate_pair, parse_time
from shared.responses.similarity import EstimateLevelResponse
from shared.responses.tracks import TrackStateResponse
from shared.tracks.evidence import Odometry, PositionFix
from shared.tracks.motion import DEFAULT_MOTION, MotionModel, motion_model
from shared.tracks.state import TrackState

Latitude = Annotated[float | None, Field(ge=-90, le=90)]
Longitude = Annotated[float | None, Field(ge=-180, le=180)]
AccuracyM = Annotated[float | None, Field(gt=0, le=100_000)]
OdometryM = Annotated[float | None, Field(ge=0, le=1_000_000)]


class TrackParams(RequestModel):
    """How a track begins. Stored as JSON with it."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    motion: Literal["walk", "bicycle", "car", "train"] | None = Field(
        None, description="how the camera moves; without it and `max_speed_mps`, as a car"
    )
    max_speed_mps: float | None = Field(
        None, gt=0, le=1000, description="maximum speed in m/s, instead of `motion`"
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.motion is not None and self.max_speed_mps is not None:
            raise ValueError("send `motion` or `max_speed_mps`, not both")
        return self

    def motion_model(self) -> MotionModel:
        """Return the motion model of the track."""
        motion = self.max_speed_mps or self.motion
        return DEFAULT_MOTION if motion is None else motion_model(motion)


class FrameForm(BaseModel):
    """The text fields of a frame's form. Position and odometry are stored as JSON with it."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    captured_at: Annotated[datetime, BeforeValidator(partial(parse_time, "captured_at"))] = Field(
        description="when the photo was taken, ISO 8601; no offset means UTC; unique in a track"
    )
    expected_version: int | None = Field(
        None,
        ge=0,
        le=2**31,
        description="`version` that the track must have (409, `track_changed`): protects from a "
        "second client",
    )
    latitude: Latitude = Field(None, description="measured position, such as of GPS, in degrees")
    longitude: Longitude = None
    accuracy_m: AccuracyM = Field(
        None, description="radius that contains the true position with a probability of 68 %"
    )
    distance_m: OdometryM = Field(None, description="odometry: way since the frame before")
    distance_accuracy_m: Annotated[float | None, Field(gt=0, le=1_000_000)] = Field(
        None, description="standard deviation of `distance_m`"
    )
    turn_degrees: float | None = Field(
        None,
        ge=-360,
        le=360,
        description="odometry: change of the heading since the frame before, clockwise",
    )
    turn_accuracy_degrees: float | None = Field(
        None, gt=0, le=180, description="standard deviation of `turn_degrees`; 10 if omitted"
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        position = (self.latitude, self.longitude, self.accuracy_m)
        if None in position and any(value is not None for value in position):
            raise ValueError("`latitude`, `longitude` and `accuracy_m` are sent together")
        if (self.distance_m is None) != (self.distance_accuracy_m is None):
            raise ValueError("`distance_m` and `distance_accuracy_m` are sent together")
        if self.turn_degrees is not None and self.distance_m is None:
            raise ValueError("`turn_degrees` needs `distance_m`")
        if self.turn_accuracy_degrees is not None and self.turn_degrees is None:
            raise ValueError("`turn_accuracy_degrees` needs `turn_degrees`")
        return self

    def fix(self) -> PositionFix | None:
        """Return the measured position, if any."""
        latitude, longitude = coordinate_pair(self.latitude, self.longitude)
        if latitude is None or longitude is None or self.accuracy_m is None:
            return None
        return PositionFix(latitude=latitude, longitude=longitude, accuracy_m=self.accuracy_m)

    def odometry(self) -> Odometry | None:
        """Return the odometry, if any."""
        if self.distance_m is None or self.distance_accuracy_m is None:
            return None
        turn_accuracy = self.turn_accuracy_degrees
        return Odometry(
            distance_m=self.distance_m,
            distance_accuracy_m=self.distance_accuracy_m,
            heading_change_degrees=self.turn_degrees,
            **({} if turn_accuracy is None else {"heading_accuracy_degrees": turn_accuracy}),
        )


FRAME_FIELDS: dict[str, dict[str, Any]] = FrameForm.model_json_schema()["properties"]


def track_state_response(state: TrackState, fix: PositionFix | None) -> TrackStateResponse:
    """Return the state of a frame: where its pose is, if that is within the finest level."""
    response = TrackStateResponse.of_row(
        state,
        image_id=None if state.photo is None else UUID(state.photo),
        levels=[EstimateLevelResponse.model_validate(level) for level in state.levels],
        not_in_map_probability=state.outside,
    )
    finest_m = response.levels[0].radius_m if response.levels else None
    if fix is None or fix.radius_95_m is None or finest_m is None:
        return response
    assert response.latitude is not None
    assert response.longitude is not None
    here = response.latitude, response.longitude
    if distance_m(*here, fix.latitude, fix.longitude) > finest_m:
        return response
    return response.model_copy(
        update={
            "latitude": fix.latitude,
            "longitude": fix.longitude,
            "heading": fix.heading,
            "radius_68_m": fix.accuracy_m,
            "radius_95_m": fix.radius_95_m,
        }
    )
