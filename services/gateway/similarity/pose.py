"""Pose of a query: where its camera stood and looked, in a reconstruction and on the earth."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from uuid import UUID

from services.gateway.dependencies import GatewayContext
from services.gateway.schemas import CameraPoseResponse, PoseCameraResponse
from shared.catalog.chunks import find_feature_rows
from shared.catalog.generations import Generation
from shared.catalog.maps import Map, Matching
from shared.catalog.reconstructions import ReconstructedComponent, current_reconstruction
from shared.errors import PlacewiseError
from shared.geometry.cameras import CameraSource
from shared.search_api.protocol import (
    ComponentPose,
    FeatureReference,
    GeographicPose,
    PoseCandidate,
    PoseComponent,
    PoseRequest,
)

log = logging.getLogger(__name__)

NOT_CALIBRATED = (
    "How far off poses are could not be measured in this component: too few of its photos find "
    "their pose without themselves. Add photos, and run `placewise reconstruct`."
)


def estimate_camera_pose(
    gateway: GatewayContext,
    map_: Map,
    generation: Generation,
    query: FeatureReference,
    photo_ids: Sequence[UUID],
    focal_length: float | None,
    camera_source: CameraSource,
    leave_out: UUID | None,
) -> CameraPoseResponse | str:
    """Return the pose of a query, or why it has none, as a sentence.

    Args:
        query: Its local features; they may not exist.
        photo_ids: The photos of the map that are most similar to it, best first.
        focal_length: As a multiple of the longer side; None if it is not known.
        camera_source: Where it comes from.
        leave_out: The query, if it is a photo of the map.
    """
    if map_.matching == Matching.OFF:
        return (
            "The map has no local features: its `matching` is off. Turn it on (`placewise maps "
            f"update {map_.name} --matching on`), then run `placewise reconstruct`."
        )
    with gateway.catalog.read() as session:
        current = current_reconstruction(session, map_.id)
        if isinstance(current, str):
            return current
        rows = find_feature_rows(session, generation.id, photo_ids)
    components = current.list_components()
    candidates = tuple(
        PoseCandidate(photo_id=photo_id, object_key=rows[photo_id][0], row=rows[photo_id][1])
        for photo_id in photo_ids
        if photo_id in rows
    )
    request = PoseRequest(
        query=query,
        candidates=candidates,
        features_model=current.features_model,
        components=tuple(map(_to_message, components)),
        focal_length=focal_length,
        camera_source=camera_source,
        leave_out=(leave_out,) if leave_out else (),
    )
    try:
        found = gateway.search.estimate_pose(request)
    except PlacewiseError as error:
        log.warning("a query is answered without a pose: %s", error)
        return error.detail
    if found.pose is None:
        return found.reason or "The query has no pose."
    return _to_response(found.pose, components[found.pose.component])


def _to_message(component: ReconstructedComponent) -> PoseComponent:
    alignment = component.alignment
    return PoseComponent(
        object_key=component.object_key,
        alignment=alignment.model_dump() if alignment else None,
        calibration=component.calibration,
    )


def _to_response(pose: ComponentPose, component: ReconstructedComponent) -> CameraPoseResponse:
    on_earth = dict.fromkeys(GeographicPose.model_fields)
    if pose.geographic:
        on_earth = pose.geographic.model_dump()
    return CameraPoseResponse(
        **on_earth,
        reason=None if pose.geographic else component.not_aligned or NOT_CALIBRATED,
        component=component.number,
        position=pose.position,
        quaternion=pose.quaternion,
        inliers=pose.inliers,
        matches=pose.matches,
        camera=PoseCameraResponse(
            focal_pixels=pose.focal_pixels,
            width=pose.width,
            height=pose.height,
            source=pose.camera_source,
        ),
        seen=list(pose.seen),
    )
