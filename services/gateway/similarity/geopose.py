"""The Open AR Cloud's requests for a pose as OGC GeoPose 1.0 (21-056r11), and their answers.

The outer frame is east, north, up at the camera. The inner frame has x in the viewing direction, y
to the left and z up, as bodies in ROS have (REP 103), so a camera with yaw 0 looks east.

GeoPoseProtocol: https://github.com/OpenArCloud/oscp-geopose-protocol. Its version 1 has a list of
readings of all sensors, whose cameras have parameters; version 2 lists each kind of readings.
"""

from __future__ import annotations

import base64
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, model_validator
from pydantic.alias_generators import to_camel

from services.gateway.similarity.search_params import SearchParams
from shared.errors import Unprocessable, invalid_field_error
from shared.geometry.cameras import Camera
from shared.geometry.colmap_model import ColmapCamera, Number
from shared.imaging.photo_header import PhotoHeader
from shared.ingest.photo_metadata import MAX_TEXT_CHARACTERS
from shared.responses import ResponseModel
from shared.responses.similarity import CameraPoseResponse, SimilarityResponse
from shared.search_api.photo_filter import Circle

MAX_GEOPOSE_BYTES = 8_000_000
"""Of a request with a photo in base64, which takes a third more than the photo"""
MAX_READINGS = 64
MIN_HINT_RADIUS_M = 100.0
"""Clients that do not know the accuracy of a position send 0"""
HINT_ACCURACIES = 2.0
SAME_SHAPE = 0.02
UNKNOWN_CAMERA = "UNKNOWN_CAMERA"
Side = Annotated[int, Field(ge=1, le=1_000_000)]


def geopose(pose: CameraPoseResponse) -> dict[str, dict[str, float]]:
    """Return the pose as a GeoPose; Unprocessable (`no_pose`) if it is not complete."""
    if pose.latitude is None or pose.longitude is None or pose.enu_quaternion is None:
        raise Unprocessable("no_pose", f"The pose has no coordinates. {pose.reason}")
    if pose.altitude_m is None:
        raise Unprocessable(
            "no_pose",
            "The pose has no height, which a GeoPose needs: too few photos of the map have an "
            "altitude. Set `altitude` of some, and run `placewise reconstruct`.",
        )
    position = {"lat": pose.latitude, "lon": pose.longitude, "h": pose.altitude_m}
    return {"position": position, "quaternion": dict(zip("wxyz", pose.enu_quaternion, strict=True))}


class _Sent(BaseModel):
    """A part of a request of the GeoPoseProtocol; what is not read is ignored."""

    model_config = ConfigDict(alias_generator=to_camel, allow_inf_nan=False)


class CameraParameters(_Sent):
    model: str = Field(UNKNOWN_CAMERA, max_length=MAX_TEXT_CHARACTERS)
    model_params: list[Number] = Field([], max_length=16, description="as COLMAP orders them")


class CameraReading(_Sent):
    image_bytes: str = Field(
        max_length=MAX_GEOPOSE_BYTES, description="the photo as a file, in base64"
    )
    size: tuple[Side, Side] | None = Field(
        None, description="width and height that the camera's parameters refer to"
    )
    image_orientation: dict[str, float] | None = Field(
        None, max_length=MAX_READINGS, description="`mirrored` and `rotation`: 0"
    )
    params: CameraParameters | None = None


class GeolocationReading(_Sent):
    latitude: float = Field(ge=-90, le=90)
    longitude: float = Field(ge=-180, le=180)
    accuracy: float | None = Field(None, ge=0, description="metres")


class SensorReadings(_Sent):
    """Only the first reading of each kind is used."""

    camera_readings: list[CameraReading] = Field(min_length=1, max_length=MAX_READINGS)
    geolocation_readings: list[GeolocationReading] = Field(
        [],
        max_length=MAX_READINGS,
        description="where to look first; other places are not excluded",
    )


def _objects(sent: Any) -> list[dict[str, Any]]:
    return [each for each in sent if isinstance(each, dict)] if isinstance(sent, list) else []


class GeoPoseRequest(_Sent):
    """A request of the GeoPoseProtocol, version 1 or 2."""

    id: str = Field("", max_length=MAX_TEXT_CHARACTERS)
    timestamp: float | Annotated[str, Field(max_length=MAX_TEXT_CHARACTERS)] | None = None
    sensor_readings: SensorReadings

    @model_validator(mode="before")
    @classmethod
    def _from_version_1(cls, sent: Any) -> Any:
        """Sort the readings of version 1 by their kind, with the parameters of their sensors."""
        if not isinstance(sent, dict) or not isinstance(sent.get("sensorReadings"), list):
            return sent
        params = {str(each.get("id")): each.get("params") for each in _objects(sent.get("sensors"))}
        found = [
            {"params": params.get(str(each.get("sensorId"))), **each["reading"]}
            for each in _objects(sent["sensorReadings"])
            if isinstance(each.get("reading"), dict)
        ]
        kinds = {"cameraReadings": "imageBytes", "geolocationReadings": "latitude"}
        by_kind = {kind: [one for one in found if key in one] for kind, key in kinds.items()}
        return {**sent, "sensorReadings": by_kind}

    def photo(self) -> bytes:
        """Return the photo as a file; Unprocessable (`invalid_field`) if it can't be read."""
        reading = self.sensor_readings.camera_readings[0]
        if any(value % 360 for value in (reading.image_orientation or {}).values()):
            raise invalid_field_error("imageOrientation", "is not upright; turn the photo")
        try:
            return base64.b64decode(reading.image_bytes.rpartition(",")[2], validate=True)
        except ValueError as error:
            raise invalid_field_error("imageBytes", f"is not base64: {error}") from error

    def search_params(self, header: PhotoHeader) -> SearchParams:
        """Return what the search needs; Unprocessable (`invalid_field`) for wrong parameters."""
        hint = None
        for place in self.sensor_readings.geolocation_readings[:1]:
            radius_m = max(MIN_HINT_RADIUS_M, HINT_ACCURACIES * (place.accuracy or 0))
            hint = Circle(latitude=place.latitude, longitude=place.longitude, radius_m=radius_m)
        return SearchParams(pose=True, hint=hint, camera=self._camera(header))

    def _camera(self, header: PhotoHeader) -> ColmapCamera | None:
        reading = self.sensor_readings.camera_readings[0]
        if reading.params is None or reading.params.model == UNKNOWN_CAMERA:
            return None
        model, params = reading.params.model, reading.params.model_params
        size = (header.width, header.height)[:: -1 if (header.quarter_turns or 0) % 2 else 1]
        width, height = reading.size or size
        if abs(width * size[1] / (size[0] * height) - 1) > SAME_SHAPE:
            raise invalid_field_error(
                "size", f"is {width} x {height}, but the photo has {size[0]} x {size[1]} pixels"
            )
        try:
            Camera.of_parameters(model, params, (width, height))
        except ValueError as error:
            raise invalid_field_error("params", str(error)) from error
        return ColmapCamera(model=model, width=width, height=height, params=params)


class GeoPoseResponse(ResponseModel):
    """A response of the GeoPoseProtocol, with OGC GeoPose 1.0, Basic-Quaternion."""

    id: str
    timestamp: float | str | None
    type: str = "geopose"
    accuracy: dict[str, float | None] = Field(
        description="`position` is `radius_68_m` of a pose, `orientation` `heading_68_degrees`"
    )
    geopose: dict[str, dict[str, float]]

    @classmethod
    def of(cls, request: GeoPoseRequest, answer: SimilarityResponse) -> GeoPoseResponse:
        """Return the response; Unprocessable (`no_pose`) without a pose, and as `geopose`."""
        pose = answer.pose
        if pose is None:
            raise Unprocessable("no_pose", answer.no_pose or "The photo has no pose.")
        return cls(
            id=request.id,
            timestamp=request.timestamp,
            accuracy={"position": pose.radius_68_m, "orientation": pose.heading_68_degrees},
            geopose=geopose(pose),
        )
