"""Pose of a query: where its camera stood and looked, in a reconstruction and on the earth."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from sqlalchemy import select

from services.gateway.dependencies import GatewayContext
from services.gateway.similarity.search_params import SearchParams
from shared.catalog.chunks import find_feature_rows
from shared.catalog.maps import Matching
from shared.catalog.photos import Photo
from shared.catalog.reconstructions import ReconstructedComponent, get_reconstruction
from shared.errors import PlacewiseError, Unprocessable
from shared.geometry.cameras import CameraSource
from shared.responses.similarity import CameraPoseResponse, EstimateResponse, PoseCameraResponse
from shared.search_api.protocol import (
    ComponentPose,
    GeographicPose,
    PoseCandidate,
    PoseComponent,
    PoseRequest,
    SearchHit,
)

if TYPE_CHECKING:
    from services.gateway.similarity.execute import SimilarityQuery

log = logging.getLogger(__name__)

POINTS_TO_DOUBLE_ODDS = 15  # that a pose is right: poses of foreign photos have fewer than 30
MAX_NOT_IN_MAP = 0.999

NOT_CALIBRATED = (
    "How far off poses are could not be measured in this component: too few of its photos find "
    "their pose without themselves. Add photos, and run `placewise reconstruct`."
)


def find_pose(
    gateway: GatewayContext,
    query: SimilarityQuery,
    hits: Sequence[SearchHit],
    search_params: SearchParams,
    estimate: EstimateResponse | None = None,
) -> CameraPoseResponse | None:
    """Return the pose of a query; None if it was not requested.

    A query without one raises PlacewiseError, whose detail is a sentence: Unprocessable
    (`no_pose`), NotFound (`no_reconstruction`), or what the search raises.

    Args:
        hits: The most similar photos, best first.
        estimate: Its "not in this map" is the prior of the pose. Floors that are built alike agree
            in their points, so in a map of labels only the estimate tells that it lacks one. Along
            coordinates, queries of another season look as if they were not in the map, and enough
            points outweigh that.
    """
    if not search_params.pose:
        return None
    against = estimate if estimate and estimate.in_map is False else None
    if against and against.levels[0].radius_m is None:
        raise Unprocessable(
            "no_pose",
            "The place is probably not in this map, and places that are built alike agree in their "
            "points. Add photos of it, and run `placewise reconstruct`.",
        )
    if query.map.matching == Matching.OFF:
        raise Unprocessable(
            "no_pose",
            "The map has no local features: its `matching` is off. Turn it on (`placewise maps "
            f"update {query.map.name} --matching on`), then run `placewise reconstruct`.",
        )
    with gateway.catalog.read() as session:
        current = get_reconstruction(session, query.map.id)
        ids = [hit.photo_id for hit in hits]
        rows = find_feature_rows(session, query.generation.id, ids)
        stored = select(Photo.id, Photo.focal_length).where(Photo.id.in_(ids))
        focal_lengths = {row.id: row.focal_length for row in session.execute(stored)}
    components = current.list_components()
    source = CameraSource.ESTIMATED if query.focal_length is None else CameraSource.EXIF
    request = PoseRequest(
        query=query.features,
        candidates=tuple(
            PoseCandidate(
                photo_id=id_,
                object_key=rows[id_][0],
                row=rows[id_][1],
                focal_length=focal_lengths.get(id_),
            )
            for id_ in ids
            if id_ in rows
        ),
        features_model=current.features_model,
        components=tuple(map(_to_message, components)),
        focal_length=search_params.focal_length or query.focal_length,
        camera_source=CameraSource.GIVEN if search_params.focal_length else source,
        camera=search_params.camera,
        camera_key=query.camera_key,
        quarter_turns=query.quarter_turns,
        leave_out=(query.photo_id,) if query.photo_id else (),
    )
    try:
        found = gateway.search.estimate_pose(request)
    except PlacewiseError as error:
        log.warning("a query is answered without a pose: %s", error)
        raise
    if found.pose is None:
        raise Unprocessable("no_pose", found.reason or "The query has no pose.")
    if against and found.pose.inliers < (needed := _points_against(against)):
        raise Unprocessable(
            "no_pose",
            f"{found.pose.inliers} points agree with a position, but the place is probably not "
            f"in this map: {needed} would be needed. Add photos of it, and run `placewise "
            "reconstruct`.",
        )
    return _to_response(found.pose, components[found.pose.component])


def _points_against(estimate: EstimateResponse) -> int:
    """Return how many points outweigh "not in this map"."""
    outside = min(max(estimate.not_in_map_probability or 0.0, 0.5), MAX_NOT_IN_MAP)
    return math.ceil(POINTS_TO_DOUBLE_ODDS * math.log2(outside / (1 - outside)))


def _to_message(component: ReconstructedComponent) -> PoseComponent:
    alignment = component.alignment
    return PoseComponent(
        object_key=component.object_key,
        alignment=alignment.model_dump() if alignment else None,
        calibration=component.calibration,
    )


def _to_response(pose: ComponentPose, component: ReconstructedComponent) -> CameraPoseResponse:
    found = pose.geographic
    return CameraPoseResponse.of_row(
        pose,
        **(found.model_dump() if found else dict.fromkeys(GeographicPose.model_fields)),
        reason=None if found else component.not_aligned or NOT_CALIBRATED,
        component=component.number,
        camera=PoseCameraResponse.of_row(pose, source=pose.camera_source),
    )
