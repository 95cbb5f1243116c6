"""Local features of a photo as they are stored, and as matchers and verification read them."""

from __future__ import annotations

import struct
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

DETECTOR = "xfeat"
"""Name of what computes the features; the health of extractors lists it beside their models."""
WORKING_SIDE = 640
"""Longer side in pixels at which keypoints are detected, and of the unit of verification."""
MIN_SIDE = 240
"""Photos whose longer side is shorter have no local features: on thumbnails they add nothing."""
MAX_KEYPOINTS = 1000
QUANTISATION = 127.0  # int8 value of a descriptor component of 1
FULL_SIDE = 65535  # uint16 position of the right and the bottom edge
_HEADER = struct.Struct("<4I")  # width, height, keypoints, dimension

Points = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class LocalFeatures:
    """Keypoints of one photo, best first, each with a descriptor."""

    width: int
    """of the upright photo, in pixels"""
    height: int
    positions: NDArray[np.uint16]
    """(n, 2) x and y as parts of the photo's sides, from 0 to FULL_SIDE"""
    descriptors: NDArray[np.int8]
    """(n, D) unit vectors times QUANTISATION, rounded"""

    @classmethod
    def quantise(
        cls,
        size: tuple[int, int],
        detected_size: tuple[int, int],
        points: NDArray[np.float32],
        descriptors: NDArray[np.float32],
    ) -> Self:
        """Round float keypoints to the stored form.

        Args:
            size: (width, height) of the upright photo.
            detected_size: (width, height) of the image that `points` refers to.
            points: (n, 2) x and y in its pixels; the centre of the first pixel is (0, 0).
            descriptors: (n, D) L2-normalised.
        """
        parts = (points + 0.5) / np.array(detected_size, np.float32)
        return cls(
            *size,
            np.clip(np.round(parts * FULL_SIDE), 0, FULL_SIDE).astype(np.uint16),
            np.clip(np.round(descriptors * QUANTISATION), -127, 127).astype(np.int8),
        )

    @classmethod
    def empty(cls, size: tuple[int, int], dimension: int) -> Self:
        """Return features without keypoints; `size` is (width, height)."""
        return cls(*size, np.empty((0, 2), np.uint16), np.empty((0, dimension), np.int8))

    def pixels(self) -> Points:
        """Return the (n, 2) positions in pixels of the upright photo; the corner is (0, 0)."""
        return self.positions * (np.array([self.width, self.height]) / FULL_SIDE)

    def moved_to(self, pixels: Points) -> Self:
        """Return the features at these (n, 2) pixels; those outside of the photo are left out."""
        size = self.width, self.height
        is_seen = ((pixels >= 0) & (pixels <= size)).all(axis=1)
        positions = np.round(pixels[is_seen] * FULL_SIDE / size).astype(np.uint16)
        return replace(self, positions=positions, descriptors=self.descriptors[is_seen])

    def working_pixels(self) -> Points:
        """Return the (n, 2) positions in pixels of the photo scaled to WORKING_SIDE."""
        return self.pixels() * (WORKING_SIDE / max(self.width, self.height))

    def encode(self) -> bytes:
        """Encode: four uint32 (width, height, n, D), then positions and descriptors, row by row."""
        header = _HEADER.pack(self.width, self.height, *self.descriptors.shape)
        return header + self.positions.astype("<u2").tobytes() + self.descriptors.tobytes()

    @classmethod
    def decode(cls, data: bytes) -> Self:
        """Decode the result of `encode`; ValueError if it is damaged."""
        if len(data) < _HEADER.size:
            raise ValueError(f"{len(data)} bytes are too few for local features")
        width, height, count, dimension = _HEADER.unpack_from(data)
        if not width or not height or len(data) != _HEADER.size + count * (4 + dimension):
            raise ValueError(f"{len(data)} bytes for {count} keypoints of {dimension} numbers")
        positions = np.frombuffer(data, "<u2", 2 * count, _HEADER.size)
        descriptors = np.frombuffer(data, np.int8, offset=_HEADER.size + 4 * count)
        return cls(
            width, height, positions.reshape(count, 2), descriptors.reshape(count, dimension)
        )
