"""The rasteriser: textured parallelograms with mipmaps and a depth buffer.

With U and V the sides of a parallelogram and O its corner in the camera's axes, and d the direction
of a pixel, the point (s, t) of the parallelogram that the pixel shows, at the depth z, is given by

    U s + V t + O = z d        so that        (s / z, t / z, 1 / z) = inverse([U V O]) d

which is linear in the pixel's coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lab.city.camera import Camera, Floats

SUPERSAMPLING = 2
"""Samples per pixel and axis"""
MIP_LEVELS = 6
MIP_BIAS = 0.25
NEAREST_M = 0.2
CORNERS = np.array([[0, 1, 1, 0], [0, 0, 1, 1], [1, 1, 1, 1]])
"""(3, 4) of a quad, in its own axes"""

Packed = NDArray[np.uint32]
"""Colour and material code (`textures`) of one sample; 0 is transparent"""
FIRST_SOLID = np.uint32(1 << 24)


class Texture:
    """An RGBA image with material codes in its fourth channel, and its mipmaps."""

    def __init__(self, image: Image.Image) -> None:
        levels = [np.asarray(image)]
        while len(levels) < MIP_LEVELS:
            levels.append(_halve(levels[-1]))
        shapes = np.array([level.shape[:2] for level in levels], np.int32)
        self.heights, self.widths = shapes.T.copy()
        sizes = shapes.prod(axis=1, dtype=np.int32)
        self._offsets = sizes.cumsum(dtype=np.int32) - sizes
        self._texels = np.concatenate([level.reshape(-1, 4) for level in levels]).view(np.uint32)

    def sample(
        self, s: NDArray[np.float32], t: NDArray[np.float32], level: NDArray[np.intp]
    ) -> Packed:
        """Return the texels at (s, t) in [0, 1), from the left and from the top."""
        widths = self.widths.take(level)
        index = (t * self.heights.take(level)).astype(np.int32) * widths
        index += (s * widths).astype(np.int32)
        found: Packed = self._texels.take(index + self._offsets.take(level))
        return found


def _halve(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Halve (h, w, 4): mean colours of what is not transparent, and one of four codes."""
    height, width = picture.shape[:2]
    padded = np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    quads = [padded[i::2, j::2] for i in (0, 1) for j in (0, 1)]
    count = np.sum([quad[..., 3] > 0 for quad in quads], axis=0)
    half: NDArray[np.uint8] = np.max(quads, axis=0)
    half[count < 2, 3] = 0
    total = np.sum([quad[..., :3] * (quad[..., 3:] > 0) for quad in quads], axis=0, dtype=np.uint16)
    half[..., :3] = total // np.maximum(count, 1)[..., None].astype(np.uint16)
    return half


@dataclass(frozen=True, slots=True, eq=False)
class Quad:
    """A textured parallelogram, seen from both sides; metres (east, north, up)."""

    corner: Floats
    """(3,) upper left corner of the texture"""
    across: Floats
    """(3,) from there to the upper right one"""
    down: Floats
    """(3,) from there to the lower left one"""
    texture: Texture
    sun: float = 0.5
    """Fraction of the sunlight"""
    tiles: tuple[float, float] = (1.0, 1.0)
    """Repetitions of the texture, across and down"""


class Canvas:
    """What a camera sees, without light; all arrays are (rows, columns) of samples."""

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self._rotation, self._position = camera.rotation, camera.position
        shape = camera.height * SUPERSAMPLING, camera.width * SUPERSAMPLING
        self.texels: Packed = np.zeros(shape, np.uint32)
        self.nearness = np.zeros(shape, np.float32)
        """1 / depth in metres, 0 for the sky"""
        self.sun = np.zeros(shape, np.float32)
        """Fraction of the sunlight"""

    def draw(self, quad: Quad) -> None:
        """Draw what is nearer than anything drawn before."""
        camera = self.camera
        sides = np.array([quad.across, quad.down, quad.corner - self._position])
        matrix = self._rotation @ sides.T
        box = self._bounds(matrix)
        if box is None or abs(np.linalg.det(matrix)) < 1e-9:
            return
        left, right, top, bottom = box
        to_quad = np.linalg.inv(matrix) / (camera.focal, camera.focal, 1.0)
        x = (np.arange(left, right) + 0.5) / SUPERSAMPLING - camera.width / 2
        y = (np.arange(top, bottom) + 0.5) / SUPERSAMPLING - camera.height / 2
        s, t, near = (
            (by_x * x).astype(np.float32) + (by_y * y + fixed).astype(np.float32)[:, None]
            for by_x, by_y, fixed in to_quad
        )
        part = slice(top, bottom), slice(left, right)
        shown = (near > self.nearness[part]) & (s >= 0) & (s < near) & (t >= 0) & (t < near)
        found = np.flatnonzero(shown)
        if not len(found):
            return
        near = near.take(found)
        scale = quad.texture.heights[0] * quad.tiles[1] / np.linalg.norm(quad.down)
        scale *= 2**MIP_BIAS / camera.focal / SUPERSAMPLING
        level = np.clip(np.log2(np.float32(scale) / near), 0, MIP_LEVELS - 1).astype(np.int32)
        s, t = s.take(found) / near, t.take(found) / near
        if quad.tiles != (1.0, 1.0):
            s, t = s * np.float32(quad.tiles[0]) % 1, t * np.float32(quad.tiles[1]) % 1
        texels = quad.texture.sample(s, t, level)
        row, column = np.divmod(found, right - left)
        place = (row + top) * self.texels.shape[1] + column + left
        solid = texels >= FIRST_SOLID
        if not solid.all():
            place, texels, near = place[solid], texels[solid], near[solid]
        self.texels.put(place, texels)
        self.nearness.put(place, near)
        self.sun.put(place, quad.sun)

    def _bounds(self, matrix: Floats) -> tuple[int, int, int, int] | None:
        """Return the left, right, top and bottom of a quad's samples; None if it has none."""
        corners = (matrix @ CORNERS).T.tolist()
        seen = []
        for a, b in zip(corners, corners[1:] + corners[:1], strict=True):
            if a[2] > NEAREST_M:
                seen.append((a[0] / a[2], a[1] / a[2]))
            if (a[2] > NEAREST_M) != (b[2] > NEAREST_M):
                share = (NEAREST_M - a[2]) / (b[2] - a[2])
                x, y = (a[n] + (b[n] - a[n]) * share for n in (0, 1))
                seen.append((x / NEAREST_M, y / NEAREST_M))
        if not seen:
            return None
        scale = self.camera.focal * SUPERSAMPLING
        found = []
        for values, size in zip(zip(*seen, strict=True), self.texels.shape[::-1], strict=True):
            first, last = size / 2 + scale * min(values), size / 2 + scale * max(values)
            found += [int(min(max(first, 0), size)), int(min(max(last + 1, 0), size))]
        left, right, top, bottom = found
        return (left, right, top, bottom) if left < right and top < bottom else None
