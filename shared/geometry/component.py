"""A component of a model: what localising a photo reads of it, as one object of the store."""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from shared.geometry.cameras import RAY_TERMS, Camera, Floats, Rays

NO_POINT = -1
MIN_INFORMATION = 1e-6
"""Least eigenvalue of a point's information as a share of the largest"""
NO_TERMS = np.zeros((RAY_TERMS, RAY_TERMS, 2))
NO_RAYS = Rays(NO_TERMS, 0.0, bytes(32), 0)
MAX_ZOOM = 1.1
"""Largest ratio of focal lengths of one camera whose photos do not tell them"""
UNREADABLE = (OSError, KeyError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error)
"""What a damaged zip file raises"""
ARRAYS: dict[str, tuple[str, tuple[int, ...]]] = {
    "photo_ids": ("u1", (16,)),
    "rotations": ("f8", (4,)),
    "translations": ("f8", (3,)),
    "camera_numbers": ("i4", ()),
    "keypoints": ("i4", ()),
    "point_numbers": ("i4", ()),
    "cameras": ("f8", (4,)),
    "rays": ("f8", (RAY_TERMS, RAY_TERMS, 2)),
    "rays_of": ("f8", (2,)),
    "camera_keys": ("u1", (32,)),
    "points": ("f8", (3,)),
    "covariances": ("f4", (3, 3)),
    "observations": ("i4", ()),
}
"""Name -> dtype and shape of a row; `keypoints` are the numbers of a photo's rows in the next.
`rays_of` are the focal length and the quarter turns of a camera's rays; 0 without rays."""


@dataclass(frozen=True, slots=True, eq=False)
class Component:
    """Photos that were reconstructed together, in a frame of their own: axes, origin and scale."""

    photo_ids: tuple[UUID, ...]
    rotations: Floats
    """(n, 4) unit quaternions w, x, y, z: from the frame to the camera's axes"""
    translations: Floats
    """(n, 3): a point X of the frame is rotation @ X + translation in the camera's axes"""
    camera_numbers: NDArray[np.int32]
    """(n,)"""
    point_numbers: tuple[NDArray[np.int32], ...]
    """for each photo (keypoints,): the point that each of its local features is, or NO_POINT"""
    cameras: tuple[Camera, ...]
    points: Floats
    """(p, 3)"""
    covariances: NDArray[np.float32]
    """(p, 3, 3) of the points, if keypoints have a standard deviation of a pixel at WORKING_SIDE"""
    observations: NDArray[np.int32]
    """(p,) photos that see the point"""

    def rotation(self, photo: int) -> Floats:
        """Return the (3, 3) rotation from the frame to the axes of a photo's camera."""
        return rotation_matrix(self.rotations[photo])

    def centres(self) -> Floats:
        """Return the (n, 3) positions of the cameras."""
        return np.array(
            [-self.rotation(i).T @ self.translations[i] for i in range(len(self.photo_ids))]
        ).reshape(-1, 3)

    def find_camera(self, camera_key: bytes) -> Camera | None:
        """Return the camera that took photos with this key: the median one, if they are alike."""
        found = [each for each in self.cameras if each.rays and each.rays.camera_key == camera_key]
        found.sort(key=lambda each: each.focal_length)
        if not found or found[-1].focal_length > MAX_ZOOM * found[0].focal_length:
            return None
        return found[len(found) // 2]

    def with_rays(self, rays: Mapping[UUID, Rays]) -> Component:
        """Return the component with the rays of photos as those of their cameras."""
        cameras = list(self.cameras)
        for photo_id, number in zip(self.photo_ids, self.camera_numbers.tolist(), strict=True):
            if photo_id in rays:
                cameras[number] = replace(cameras[number], rays=rays[photo_id], radial=0.0)
        return replace(self, cameras=tuple(cameras))

    def rays(self) -> dict[UUID, Rays]:
        """Return the rays of the photos whose cameras have some."""
        numbers = zip(self.photo_ids, self.camera_numbers.tolist(), strict=True)
        found = ((photo_id, self.cameras[number].rays) for photo_id, number in numbers)
        return {photo_id: rays for photo_id, rays in found if rays is not None}

    def encode(self) -> bytes:
        """Encode as a compressed npz of the arrays in ARRAYS."""
        buffer = io.BytesIO()
        rays = [camera.rays or NO_RAYS for camera in self.cameras]
        arrays: dict[str, Any] = {
            "photo_ids": np.array([list(i.bytes) for i in self.photo_ids]).reshape(-1, 16),
            "rotations": self.rotations,
            "translations": self.translations,
            "camera_numbers": self.camera_numbers,
            "keypoints": [len(numbers) for numbers in self.point_numbers],
            "point_numbers": np.concatenate([*self.point_numbers, np.empty(0, np.int32)]),
            "cameras": np.array(
                [[c.width, c.height, c.focal_pixels, c.radial] for c in self.cameras]
            ).reshape(-1, 4),
            "rays": np.array([each.coefficients for each in rays]).reshape(-1, *NO_TERMS.shape),
            "rays_of": np.array([[each.focal_length, each.quarter_turns] for each in rays]).reshape(
                -1, 2
            ),
            "camera_keys": np.array([list(each.camera_key) for each in rays]).reshape(-1, 32),
            "points": self.points,
            "covariances": self.covariances,
            "observations": self.observations,
        }
        stored: dict[str, Any] = {
            name: np.asarray(arrays[name], ARRAYS[name][0]) for name in ARRAYS
        }
        np.savez_compressed(buffer, **stored)
        return buffer.getvalue()

    @classmethod
    def decode(cls, data: bytes) -> Self:
        """Decode the result of `encode`; ValueError if it is damaged."""
        try:
            with np.load(io.BytesIO(data), allow_pickle=False) as file:
                arrays = {name: file[name] for name in ARRAYS}
        except (*UNREADABLE, ValueError) as error:
            raise ValueError(f"no component of a model: {error}") from error
        for name, (dtype, shape) in ARRAYS.items():
            found = arrays[name]
            if found.dtype != dtype or found.shape[1:] != shape or not found.ndim:
                raise ValueError(f"{name} are {found.dtype} of shape {found.shape}")
            if not np.isfinite(found).all():
                raise ValueError(f"{name} are not finite")
        _check(arrays)
        stops = np.cumsum(arrays["keypoints"])[:-1]
        return cls(
            tuple(UUID(bytes=row.tobytes()) for row in arrays["photo_ids"]),
            arrays["rotations"],
            arrays["translations"],
            arrays["camera_numbers"],
            tuple(np.split(arrays["point_numbers"], stops)) if len(arrays["keypoints"]) else (),
            tuple(
                Camera(int(w), int(h), f, k, Rays(terms, of[0], key.tobytes(), int(of[1])))
                if of[0] > 0
                else Camera(int(w), int(h), f, k)
                for (w, h, f, k), terms, of, key in zip(
                    arrays["cameras"].tolist(),
                    arrays["rays"],
                    arrays["rays_of"].tolist(),
                    arrays["camera_keys"],
                    strict=True,
                )
            ),
            arrays["points"],
            arrays["covariances"],
            arrays["observations"],
        )


def _check(arrays: dict[str, NDArray[Any]]) -> None:
    photos, points = len(arrays["photo_ids"]), len(arrays["points"])
    for name in ("rotations", "translations", "camera_numbers", "keypoints"):
        if len(arrays[name]) != photos:
            raise ValueError(f"{len(arrays[name])} {name} for {photos} photos")
    for name in ("rays", "rays_of", "camera_keys"):
        if len(arrays[name]) != len(arrays["cameras"]):
            raise ValueError(f"{len(arrays[name])} {name} for {len(arrays['cameras'])} cameras")
    for name in ("covariances", "observations"):
        if len(arrays[name]) != points:
            raise ValueError(f"{len(arrays[name])} {name} for {points} points")
    counts, numbers = arrays["keypoints"], arrays["point_numbers"]
    if (counts < 0).any() or counts.sum() != len(numbers):
        raise ValueError(f"{counts.sum()} keypoints with {len(numbers)} point numbers")
    if len(numbers) and not NO_POINT <= numbers.min() <= numbers.max() < points:
        raise ValueError("a keypoint has the number of a point that is not there")
    cameras = arrays["camera_numbers"]
    if photos and not 0 <= cameras.min() <= cameras.max() < len(arrays["cameras"]):
        raise ValueError("a photo has the number of a camera that is not there")
    if (arrays["cameras"][:, :3] <= 0).any():
        raise ValueError("a camera has no size or focal length")
    if photos and np.abs(np.linalg.norm(arrays["rotations"], axis=1) - 1).max() > 1e-6:
        raise ValueError("a rotation is no unit quaternion")


def projection_jacobian(
    points: Floats, rotation: Floats, translation: Floats, focal_pixels: float
) -> Floats:
    """Return the (m, 2, 3) derivatives of the pixels of points (m, 3), without distortion."""
    seen = points @ rotation.T + translation
    jacobian = np.zeros((len(points), 2, 3))
    jacobian[:, 0, 0] = jacobian[:, 1, 1] = 1
    jacobian[:, :, 2] = -seen[:, :2] / seen[:, 2:]
    found: Floats = jacobian * (focal_pixels / seen[:, 2, None, None]) @ rotation
    return found


def bounded_inverse(information: Floats) -> Floats:
    """Return the inverses of (p, 3, 3), bounded where a point's distance is hardly known."""
    values, vectors = np.linalg.eigh(information)
    values = np.maximum(values, np.maximum(values[:, -1:], 1e-9) * MIN_INFORMATION)
    found: Floats = vectors / values[:, None, :] @ vectors.transpose(0, 2, 1)
    return found


def rotation_matrix(quaternion: Floats | Sequence[float]) -> Floats:
    """Return the (3, 3) matrix of a unit quaternion w, x, y, z."""
    w, x, y, z = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_of(rotation: Floats) -> Floats:
    """Return the (4,) unit quaternion w, x, y, z, w >= 0, of a (3, 3) rotation.

    It is the eigenvector of Bar-Itzhack's symmetric matrix (J. Guidance 23(6), 2000), which no
    rotation makes singular.
    """
    m = rotation
    k = np.array(
        [
            [m[0, 0] + m[1, 1] + m[2, 2], 0.0, 0.0, 0.0],
            [m[2, 1] - m[1, 2], m[0, 0] - m[1, 1] - m[2, 2], 0.0, 0.0],
            [m[0, 2] - m[2, 0], m[1, 0] + m[0, 1], m[1, 1] - m[0, 0] - m[2, 2], 0.0],
            [
                m[1, 0] - m[0, 1],
                m[2, 0] + m[0, 2],
                m[2, 1] + m[1, 2],
                m[2, 2] - m[0, 0] - m[1, 1],
            ],
        ]
    )
    quaternion: Floats = np.linalg.eigh(k, "L")[1][:, -1]
    return quaternion if quaternion[0] >= 0 else -quaternion
