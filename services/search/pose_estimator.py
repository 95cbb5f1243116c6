"""Computes the pose of a query in a reconstruction, whose components are read from the store."""

from __future__ import annotations

import logging
import threading
from collections.abc import Sequence
from dataclasses import asdict, replace
from operator import attrgetter
from typing import Any
from uuid import UUID

import numpy as np
from cachetools import LRUCache, cachedmethod

from services.search.photo_matcher import PhotoMatcher, match_threads, unusable_query_reason
from shared.errors import NotFound, Unprocessable
from shared.geometry.cameras import Camera, CameraSource, hash_camera_key
from shared.geometry.component import Component, quaternion_of
from shared.geometry.frames import EastNorthUp, Similarity
from shared.geometry.localise import LocalPose, localise
from shared.geometry.radius import PoseCalibration, geo_pose
from shared.matching.features import LocalFeatures
from shared.search_api.protocol import (
    MAX_SEEN_POINTS,
    ComponentPose,
    GeographicPose,
    PoseComponent,
    PoseRequest,
    PoseResponse,
)
from shared.storage import ObjectStore

log = logging.getLogger(__name__)

CACHED_COMPONENT_BYTES = 128_000_000  # of 5,000 photos of 1,000 keypoints and 200 points each
MAX_CANDIDATES = 20  # photos of the components that the query is matched with
SAME_FOCAL, SAME_SHAPE = 1e-3, 0.01  # relative differences of photos of one camera


class PoseEstimator:
    """Localises queries; thread-safe. `photos` reads the local features."""

    def __init__(self, store: ObjectStore, photos: PhotoMatcher) -> None:
        self._store = store
        self._photos = photos
        self._lock = threading.Lock()
        self._components: LRUCache[Any, Component] = LRUCache(
            CACHED_COMPONENT_BYTES, getsizeof=_size_bytes
        )

    def estimate(self, request: PoseRequest) -> PoseResponse:
        """See `SearchBackend.estimate_pose`; Unavailable while the object store can't be read."""
        query = self._photos.read_features(request.query)
        if query is None or not len(query[1].positions):
            return PoseResponse(reason=unusable_query_reason(query))
        if query[0] != request.features_model:
            return PoseResponse(
                reason=f"The query has local features of {query[0]}, and the reconstruction those "
                f"of {request.features_model}. Send the photo again, or make a new "
                "reconstruction: `placewise reconstruct`."
            )
        found = [self._read_component(each.object_key) for each in request.components]
        components = {number: one for number, one in enumerate(found) if one is not None}
        if not components:
            return PoseResponse(
                reason="The reconstruction can't be read: its objects are missing or damaged. Make "
                "a new one: `placewise reconstruct`."
            )
        members = {photo for one in components.values() for photo in one.photo_ids}
        members -= set(request.leave_out)
        chosen = [one for one in request.candidates if one.photo_id in members][:MAX_CANDIDATES]
        read = list(match_threads().map(self._photos.read_features, chosen))
        candidates = [
            (candidate.photo_id, features[1])
            for candidate, features in zip(chosen, read, strict=True)
            if features is not None and features[0] == request.features_model
        ]
        if not candidates:
            return PoseResponse(
                reason=f"None of the {len(request.candidates)} most similar photos belongs to the "
                "reconstruction. It does not cover this place, or photos were added since: add "
                "them with `placewise reconstruct`."
            )
        try:
            pose = localise(
                query[1],
                candidates,
                list(components.values()),
                *_camera(request, query[1], list(components.values())),
                frozenset(request.leave_out),
            )
        except Unprocessable as error:
            return PoseResponse(reason=error.detail)
        except np.linalg.LinAlgError as error:  # the search itself has an answer
            log.warning("a pose can't be computed: %s", error)
            return PoseResponse(reason="The points of the model that match determine no position.")
        number = list(components)[pose.component]
        return PoseResponse(pose=_to_message(pose, number, request.components[number]))

    def _read_component(self, key: str) -> Component | None:
        try:
            return self._read_cached(key)
        except NotFound:
            log.warning("the component %s of a reconstruction is missing", key)
        except ValueError as error:
            log.warning("the component %s of a reconstruction is damaged: %s", key, error)
        return None

    @cachedmethod(attrgetter("_components"), lock=attrgetter("_lock"))
    def _read_cached(self, key: str) -> Component:
        return Component.decode(self._store.get(key))


def _size_bytes(component: Component) -> int:
    arrays = (component.points, component.covariances, component.observations)
    numbers = sum(each.nbytes for each in component.point_numbers)
    return 1000 * len(component.photo_ids) + numbers + sum(each.nbytes for each in arrays)


def _camera(
    request: PoseRequest, query: LocalFeatures, components: Sequence[Component]
) -> tuple[Camera | None, CameraSource]:
    """Return the camera of the query, if it is known, and where it comes from.

    Cameras of the reconstruction were refined together with it: that of the query itself, if it is
    one of its photos; that with the query's `camera_key`, if it was imported; or that of a photo of
    the same shape and with the same focal length in its EXIF. An imported one has a principal point
    and distortion, too, which a focal length that is given leaves as they are.
    """
    size = query.width, query.height
    if sent := request.camera:
        camera = Camera.of_parameters(sent.model, sent.params, (sent.width, sent.height))
        assert camera.rays is not None
        camera = replace(camera, rays=camera.rays.turned(request.quarter_turns))
        return camera.resized(*size), CameraSource.GIVEN
    known = _find_camera(request, size, components)
    if request.focal_length is not None and request.camera_source == CameraSource.GIVEN:
        if known is None or known.rays is None:
            known = Camera.of_focal_length(*size, request.focal_length)
        return known.resized(*size).with_focal_length(request.focal_length), CameraSource.GIVEN
    if known is not None:
        return known.resized(*size), CameraSource.MAP
    if request.focal_length is None:
        return None, CameraSource.ESTIMATED
    camera = Camera.of_focal_length(*size, request.focal_length)
    return camera, CameraSource(request.camera_source)


def _find_camera(
    request: PoseRequest, size: tuple[int, int], components: Sequence[Component]
) -> Camera | None:
    """Return the camera of the reconstruction that took the query, as far as photos tell it."""
    cameras: dict[UUID, Camera] = {
        photo_id: component.cameras[number]
        for component in components
        for photo_id, number in zip(
            component.photo_ids, component.camera_numbers.tolist(), strict=True
        )
    }
    if own := next((cameras[id_] for id_ in request.leave_out if id_ in cameras), None):
        return own
    if request.camera_key is not None:
        key = hash_camera_key(request.camera_key)
        imported = next(filter(None, (each.find_camera(key) for each in components)), None)
        if imported is not None and imported.rays is not None:
            return replace(imported, rays=imported.rays.turned(request.quarter_turns))
    if request.focal_length is None:
        return None
    for candidate in request.candidates:
        camera = cameras.get(candidate.photo_id)
        # Other imported cameras have distortions of their own.
        if camera is None or camera.rays is not None or candidate.focal_length is None:
            continue
        shape = camera.width * size[1] / camera.height / size[0]
        zoom = candidate.focal_length / request.focal_length
        if abs(shape - 1) < SAME_SHAPE and abs(zoom - 1) < SAME_FOCAL:
            return camera
    return None


def _to_message(pose: LocalPose, number: int, component: PoseComponent) -> ComponentPose:
    count = len(pose.seen_pixels)
    shown = np.unique(np.linspace(0, count - 1, min(count, MAX_SEEN_POINTS)).astype(int))
    pixels, points = pose.seen_pixels[shown].round(1), pose.seen_points[shown]
    return ComponentPose.model_validate(
        {
            "component": number,
            "position": pose.position.tolist(),
            "quaternion": quaternion_of(pose.rotation).tolist(),
            "inliers": pose.inliers,
            "matches": pose.matches,
            **asdict(pose.camera),
            "camera_source": pose.camera_source,
            "seen": [
                {"query": pixel, "point": point}
                for pixel, point in zip(pixels.tolist(), points.tolist(), strict=True)
            ],
            "geographic": _geographic(pose, component),
        }
    )


def _geographic(pose: LocalPose, component: PoseComponent) -> GeographicPose | None:
    if component.alignment is None or component.calibration is None:
        return None
    found = geo_pose(
        pose,
        EastNorthUp(*component.alignment["origin"]),
        Similarity.from_json(component.alignment["similarity"]),
        PoseCalibration.model_validate(component.calibration),
    )
    values = {**asdict(found), **asdict(found.attitude), "enu_quaternion": found.quaternion}
    return GeographicPose.model_validate(values)
