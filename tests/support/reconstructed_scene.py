"""A reconstructed scene with exact poses: photos, their local features, and queries of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from shared.geometry.cameras import Camera, Floats, Rays
from shared.geometry.component import NO_POINT, Component, quaternion_of
from shared.matching.features import LocalFeatures

CAMERA = Camera(640, 480, 500.0)
DIMENSION = 64


def looking(from_: Floats, to: Floats) -> Floats:
    """Return the (3, 3) rotation to the axes of a camera that looks from one point to another.

    The scene's z is up.
    """
    forward = (to - from_) / np.linalg.norm(to - from_)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.array([right, np.cross(forward, right), forward])


def rays_of(camera: Camera, camera_key: bytes, scale: float = 1.0) -> Rays:
    """Return the rays of a camera whose pixels are scaled from the top left corner."""
    size = camera.width, camera.height

    def look(pixels: Floats) -> Floats:
        plane = (pixels / scale - np.array(size) / 2) / camera.focal_pixels
        return np.column_stack([plane, np.ones(len(plane))])

    return Rays.fit(look, size, camera.focal_length, camera_key, 0)


@dataclass
class ReconstructedScene:
    """Points in a box of 20 by 6 by 6, at y from 8 to 14, seen from around (0, 0, 0)."""

    photos: int = 6
    points: int = 400
    seed: int = 0
    noise_pixels: float = 0.5
    camera: Camera = CAMERA
    component: Component = field(init=False)
    features: dict[UUID, LocalFeatures] = field(init=False)

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)
        low, high = (-10.0, 8.0, -2.0), (10.0, 14.0, 4.0)
        self.xyz = self.rng.uniform(low, high, (self.points, 3))
        self.descriptors = self.rng.normal(size=(self.points, DIMENSION))
        self.descriptors /= np.linalg.norm(self.descriptors, axis=1, keepdims=True)
        ids = tuple(UUID(int=(self.seed << 64) + n + 1) for n in range(self.photos))
        centres = np.column_stack(
            [
                np.linspace(-4, 4, self.photos),
                self.rng.normal(0, 0.7, self.photos),
                self.rng.normal(0, 0.1, self.photos),
            ]
        )
        rotations = [looking(c, np.array([0.5 * c[0], 11.0, 1.0])) for c in centres]
        seen = [self.take(r, c) for r, c in zip(rotations, centres, strict=True)]
        self.features = dict(zip(ids, (features for features, _ in seen), strict=True))
        counts = np.zeros(self.points, np.int32)
        for _, numbers in seen:
            counts[numbers] += 1
        self.component = Component(
            ids,
            np.array([quaternion_of(r) for r in rotations]),
            np.array([-r @ c for r, c in zip(rotations, centres, strict=True)]),
            np.zeros(self.photos, np.int32),
            tuple(np.where(counts[n] >= 2, n, NO_POINT).astype(np.int32) for _, n in seen),
            (self.camera,),
            self.xyz,
            np.tile(np.eye(3, dtype=np.float32) * 1e-4, (self.points, 1, 1)),
            counts,
        )

    @property
    def candidates(self) -> list[tuple[UUID, LocalFeatures]]:
        return list(self.features.items())

    def take(
        self,
        rotation: Floats,
        centre: Floats,
        camera: Camera | None = None,
        wrong: float = 0.0,
    ) -> tuple[LocalFeatures, NDArray[np.int32]]:
        """Return the features of a photo, and the points that they are.

        `wrong` is the share of the keypoints whose descriptor is that of another point.
        """
        camera = camera or self.camera
        seen = (self.xyz - centre) @ rotation.T
        numbers = np.flatnonzero(seen[:, 2] > 0.1)
        pixels = camera.project(seen[numbers])
        pixels += self.rng.normal(0, self.noise_pixels, pixels.shape)
        size = np.array([camera.width, camera.height])
        inside = ((pixels > 0) & (pixels < size)).all(axis=1)
        numbers, pixels = numbers[inside].astype(np.int32), pixels[inside]
        shown = numbers.copy()
        changed = self.rng.uniform(size=len(shown)) < wrong
        shown[changed] = self.rng.permutation(shown[changed])
        features = LocalFeatures.quantise(
            (camera.width, camera.height),
            (camera.width, camera.height),
            (pixels - 0.5).astype(np.float32),
            self.descriptors[shown].astype(np.float32),
        )
        return features, numbers.astype(np.int32)
