"""Camera, ray casting, the mipmapped texture cache, and texture sampling.

The camera is an upright pinhole camera. A point at `depth` metres along the optical axis, `lateral`
metres to its right and `z` metres above the ground is projected to

    x = width / 2 + f * lateral / depth            y = horizon + f * (eye - z) / depth

with f = width / 2 / tan(fov / 2). A camera that rolls by r adds tan(r) * (x - width / 2) to y.

All textures of a rendering process are in one flat array, with their mipmaps, so that one gather
reads a different texture at a different size for every column of a photo. Textures are stored
column by column, so that a photo's column reads contiguous memory.

The canvas of a photo has twice its resolution and is stored column by column (the first axis is x):
a vertical plane is linear in a column, so one multiply and one gather fill all columns at once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Camera:
    """A pinhole camera; metres, degrees and pixels."""

    x: float
    """east"""
    y: float
    """north"""
    yaw: float
    """degrees clockwise from north"""
    fov: float
    """horizontal field of view, degrees"""
    eye: float = 1.9
    """height above the ground"""
    width: int = 320
    height: int = 240
    horizon: float = 0.60
    """Row of the horizon, as a fraction of the height"""
    roll: float = 0.0
    """degrees"""

    @property
    def focal(self) -> float:
        """Focal length in pixels."""
        return self.width / 2 / math.tan(math.radians(self.fov) / 2)

    @property
    def forward(self) -> Floats:
        """(2,) unit vector of the optical axis."""
        yaw = math.radians(self.yaw)
        return np.array([math.sin(yaw), math.cos(yaw)])

    @property
    def right(self) -> Floats:
        """(2,) unit vector to the right of the optical axis."""
        yaw = math.radians(self.yaw)
        return np.array([math.cos(yaw), -math.sin(yaw)])

    @property
    def position(self) -> Floats:
        """(2,) east and north in metres."""
        return np.array([self.x, self.y])

    def slopes(self, supersampling: int) -> Floats:
        """Return the (columns,) lateral metres per metre of depth at the centre of each column."""
        columns = (np.arange(self.width * supersampling) + 0.5) / supersampling
        return (columns - self.width / 2) / self.focal

    def horizons(self, supersampling: int) -> Floats:
        """Return the (columns,) row of the horizon in each column, in photo pixels."""
        lean = math.tan(math.radians(self.roll)) * self.focal
        return self.horizon * self.height + lean * self.slopes(supersampling)

    def project(self, points: Floats) -> tuple[Floats, Floats, Floats]:
        """Project (n, 3) metres (east, north, up) to x and y in pixels and depth in metres."""
        relative = points[:, :2] - self.position
        depth = relative @ self.forward
        x = self.width / 2 + self.focal * (relative @ self.right) / depth
        lean = math.tan(math.radians(self.roll)) * (x - self.width / 2)
        y = self.horizon * self.height + self.focal * (self.eye - points[:, 2]) / depth + lean
        return x, y, depth


@dataclass(frozen=True, slots=True)
class RayHits:
    """The nearest plane for each column; depth is infinite if there is none."""

    depth: Floats
    plane: NDArray[np.int64]
    """Index into the planes that were passed"""
    along: Floats
    """Metres from the plane's start"""
    facing: Floats
    """Metres along the plane's normal per metre of depth"""


def cast_rays(
    camera: Camera, slopes: Floats, starts: Floats, directions: Floats, lengths: Floats
) -> RayHits:
    """Cast rays against one-sided vertical planes and return the nearest hits.

    A plane is visible if its direction runs from left to right in the image, and invisible from
    behind.

    Args:
        slopes: (columns,) lateral metres per metre of depth of each ray.
        starts: (planes, 2) start points in metres.
        directions: (planes, 2) unit vectors.
        lengths: (planes,) metres.
    """
    rays = camera.forward + slopes[:, None] * camera.right  # (columns, 2)
    relative = starts - camera.position
    across = rays[:, :1] * directions[:, 1] - rays[:, 1:] * directions[:, 0]  # (columns, planes)
    # The normal to the right of the direction is (d_y, -d_x): its product with the ray is `across`.
    visible = across < -1e-9
    divisor = np.where(visible, across, -1.0)
    depth = (relative[:, 0] * directions[:, 1] - relative[:, 1] * directions[:, 0]) / divisor
    along = (relative[:, 0] * rays[:, 1:] - relative[:, 1] * rays[:, :1]) / divisor
    depth = np.where(visible & (depth > 0.3) & (along >= 0) & (along <= lengths), depth, np.inf)
    plane = depth.argmin(axis=1)
    rows = np.arange(len(slopes))
    return RayHits(
        depth=depth[rows, plane],
        plane=plane,
        along=np.clip(along[rows, plane], 0, lengths[plane]),
        facing=-across[rows, plane],
    )


MIP_LEVELS = 6
"""Each with half the resolution of the one before"""
MIP_SIZE_FACTOR = 1.36
"""Pixels of all levels per pixel of the first: 4 / 3, plus rounding"""
SPARE_PIXELS = 6_000_000
"""More than all trees, vehicles and tiles of a catalogue together"""

Packed = NDArray[np.uint32]


@dataclass(frozen=True, slots=True)
class MipmappedTexture:
    """Location of a texture and its mipmaps in the cache, one entry per level."""

    offsets: NDArray[np.int64]
    widths: NDArray[np.int64]
    """Columns"""
    heights: NDArray[np.int64]
    """Rows, which is also the stride between columns"""


class TextureCache:
    """Cache of textures by key; when it is full, it is cleared and textures are drawn again."""

    def __init__(self, capacity: int = 36_000_000) -> None:
        """`capacity`: pixels of 4 bytes; memory is committed only when used."""
        self.pixels: Packed = np.zeros(capacity, np.uint32)
        self._used = 0
        self._textures: dict[Hashable, MipmappedTexture] = {}

    def reserve(self, textures: Mapping[Hashable, int]) -> None:
        """Clear the cache if textures, given by key with their pixels, would not fit.

        SPARE_PIXELS are left free for textures that the same photo needs later, because textures
        must not be evicted while they are in use.
        """
        missing = sum(pixels for key, pixels in textures.items() if key not in self._textures)
        if self._used + missing * MIP_SIZE_FACTOR + SPARE_PIXELS > len(self.pixels):
            self._used = 0
            self._textures.clear()

    def get(self, key: Hashable, draw: Callable[[], Image.Image], *, rim: bool) -> MipmappedTexture:
        """Return a texture, drawing it if it is not cached.

        `rim` adds a transparent border of one pixel to every level, for sprites.
        """
        if key not in self._textures:
            self._textures[key] = self._store(np.asarray(draw()), rim)
        return self._textures[key]

    def _store(self, picture: NDArray[np.uint8], rim: bool) -> MipmappedTexture:
        offsets, widths, heights = [], [], []
        for level in range(MIP_LEVELS):
            if level:
                picture = _downsample(picture, ignore_transparent=rim)
            stored = np.pad(picture, ((1, 1), (1, 1), (0, 0))) if rim else picture
            packed = np.ascontiguousarray(stored.transpose(1, 0, 2)).view(np.uint32).ravel()
            self.pixels[self._used : self._used + len(packed)] = packed
            offsets.append(self._used)
            heights.append(stored.shape[0])
            widths.append(stored.shape[1])
            self._used += len(packed)
        return MipmappedTexture(np.array(offsets), np.array(widths), np.array(heights))


def _downsample(picture: NDArray[np.uint8], *, ignore_transparent: bool) -> NDArray[np.uint8]:
    """Halve (h, w, 4) to (ceil(h / 2), ceil(w / 2), 4): mean colours, and one of four codes.

    `ignore_transparent` excludes transparent pixels from the mean, for outlines against the sky.
    """
    if not ignore_transparent:
        high, wide = picture.shape[:2]
        # As RGBX, so that Pillow treats all four bytes as equal channels, without alpha.
        whole = Image.frombuffer("RGBX", (wide, high), picture.tobytes(), "raw", "RGBX", 0, 1)
        half = np.array(whole.reduce(2))
        half[..., 3] = picture[::2, ::2, 3]
        return half
    height, width = picture.shape[:2]
    picture = np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    quads = picture.reshape(picture.shape[0] // 2, 2, picture.shape[1] // 2, 2, 4)
    small = np.empty((quads.shape[0], quads.shape[2], 4), np.uint8)
    solid = (quads[..., 3] > 0).astype(np.uint16)
    count = solid.sum(axis=(1, 3))
    total = (quads[..., :3].astype(np.uint16) * solid[..., None]).sum(axis=(1, 3))
    small[..., :3] = total // np.maximum(count, 1)[..., None]
    small[..., 3] = np.where(count >= 2, quads[..., 3].max(axis=(1, 3)), 0)
    return small


SUPERSAMPLING = 2
"""Canvas pixels per photo pixel and axis"""


@dataclass(slots=True)
class RenderBuffers:
    """Unlit rendering of a view; all arrays are indexed (x, y)."""

    canvas: Packed
    """(SUPERSAMPLING * width, SUPERSAMPLING * height) colours and codes, 0 for sky"""
    depth: NDArray[np.float32]
    """(width, height) metres, infinite for sky"""
    sun: NDArray[np.float32]
    """(width, height) fraction of direct sunlight"""
    lamp: NDArray[np.float32]
    """(width,) fraction of street lamp light"""


def sample_texture(
    cache: TextureCache,
    camera: Camera,
    columns: NDArray[np.int64],
    depth: Floats,
    top: Floats,
    scale: Floats,
    offset: NDArray[np.int64],
    rows: NDArray[np.int64],
    first: int,
    last: int,
    rim: int = 0,
) -> Packed:
    """Sample (columns, last - first) texels of canvas rows `first` to `last`.

    `top`: height of the texture's upper edge in metres; `scale`: texels per metre; `offset` and
    `rows`: position and height of each texture column in the cache.
    """
    per_row = (scale * depth / camera.focal).astype(np.float32)
    horizon = camera.horizons(SUPERSAMPLING)[columns]
    start = (scale * (top - camera.eye) - per_row * horizon).astype(np.float32) + rim
    ys = ((np.arange(first, last) + 0.5) / SUPERSAMPLING).astype(np.float32)
    v = per_row[:, None] * ys
    v += start[:, None]
    np.clip(v, 0, (rows - 1)[:, None], out=v)
    index = v.astype(np.int32)
    index += offset.astype(np.int32)[:, None]
    return cache.pixels.take(index)


def choose_mip_level(
    finest: float, depth: NDArray[np.floating], camera: Camera, bias: float = 0.25
) -> NDArray[np.int64]:
    """Choose the mipmap level with about one texel per canvas pixel."""
    texels = finest * depth / (camera.focal * SUPERSAMPLING)
    return np.asarray(np.clip(np.log2(np.maximum(texels, 1.0)) + bias, 0, MIP_LEVELS - 1), np.int64)


def project_row(camera: Camera, z: float, depth: Floats, columns: NDArray[np.int64]) -> Floats:
    """Return the canvas row of the height `z` at each column's depth."""
    horizon = camera.horizons(SUPERSAMPLING)[columns]
    return np.asarray((horizon + camera.focal * (camera.eye - z) / depth) * SUPERSAMPLING)
