"""OGC GeoPose 1.0 (21-056r11), Basic-Quaternion and Basic-YPR, as another form of an answer.

The outer frame is east, north, up at the camera. The inner frame has x in the viewing direction, y
to the left and z up, as bodies in ROS have (REP 103), so a camera with yaw 0 looks east.
"""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import Depends, Request
from fastapi.responses import JSONResponse

from services.gateway.similarity.search_params import SearchParams
from shared.errors import Unprocessable
from shared.responses.similarity import CameraPoseResponse, SimilarityResponse

MEDIA_TYPE = "application/geopose+json"
JSON_TYPE = "application/json"


GEOPOSE: dict[int | str, dict[str, Any]] = {
    200: {
        "content": {
            MEDIA_TYPE: {
                "schema": {
                    "type": "object",
                    "required": ["position"],
                    "description": "the pose as OGC GeoPose 1.0, in the form `geopose`; 422 "
                    "(`no_pose`) if there is none",
                }
            }
        }
    }
}


def _accepts_geopose(request: Request) -> bool:
    """Whether the header `Accept` names GeoPose, and does not prefer JSON."""
    qualities = {}
    for accepted in request.headers.get("accept", "").lower().split(","):
        name, *parameters = (part.strip() for part in accepted.split(";"))
        values = dict(parameter.partition("=")[::2] for parameter in parameters)
        try:
            qualities[name] = float(values.get("q", 1))
        except ValueError:
            qualities[name] = 0.0
    return qualities.get(MEDIA_TYPE, 0) > 0 and (
        qualities[MEDIA_TYPE] >= qualities.get(JSON_TYPE, 0)
    )


GeoPoseDep = Annotated[bool, Depends(_accepts_geopose)]
"""Whether the answer is to be a GeoPose."""


def with_geopose(answer: SimilarityResponse, search_params: SearchParams, accepted: bool) -> Any:
    """Return the answer, or its pose as GeoPose if that is accepted.

    Raises:
        Unprocessable: `no_pose`.
    """
    if not accepted:
        return answer
    if answer.pose is None:
        raise Unprocessable(
            "no_pose", answer.no_pose or "The query was sent without `pose=true`. Send it again."
        )
    content = geopose(answer.pose, search_params.geopose)
    return JSONResponse(content, media_type=MEDIA_TYPE)


def geopose(pose: CameraPoseResponse, form: str) -> dict[str, dict[str, Any]]:
    """Return the pose as a GeoPose; Unprocessable (`no_pose`) if it is not complete."""
    if pose.latitude is None or pose.longitude is None:
        raise Unprocessable("no_pose", f"The pose has no coordinates. {pose.reason}")
    if pose.altitude_m is None:
        raise Unprocessable(
            "no_pose",
            "The pose has no height, which a GeoPose needs: too few photos of the map have an "
            "altitude. Set `altitude` of some, and run `placewise reconstruct`.",
        )
    assert pose.heading is not None
    assert pose.pitch is not None
    assert pose.enu_quaternion is not None
    position = {"lat": pose.latitude, "lon": pose.longitude, "h": pose.altitude_m}
    if form == "ypr":
        yaw = (270 - pose.heading) % 360 - 180
        angles = {"yaw": yaw, "pitch": -pose.pitch, "roll": pose.roll}
        return {"position": position, "angles": angles}
    return {"position": position, "quaternion": dict(zip("wxyz", pose.enu_quaternion, strict=True))}
