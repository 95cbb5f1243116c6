"""A pinhole camera that stands upright in the street, and its rays against vertical planes.

A point at `depth` metres along the optical axis, `lateral` metres to its right and `z` metres above
the ground is seen at

    x = width / 2 + f * lateral / depth            y = horizon + f * (eye - z) / depth

with f = width / 2 / tan(fov / 2). A camera that rolls by r adds tan(r) * (x - width / 2) to y.

All textures of a drawing process in one flat array, each with its smaller copies.

One flat array lets a single gather read, for every column of a photo, from another texture at
another size. Textures lie column by column, so that a photo's column reads neighbouring memory.

The canvas that one photo is painted on, and reading textures onto its columns.

It is twice as fine as the photo and lies column by column (the first axis is x): a vertical plane
is linear in a column, so that one multiply and one gather fill all columns at once.
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
    """Metres, degrees and pixels."""

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
    """its row, as a share of the height"""
    roll: float = 0.0
    """degrees"""

    @property
    def focal(self) -> float:
        """pixels"""
        return self.width / 2 / math.tan(math.radians(self.fov) / 2)

    @property
    def forward(self) -> Floats:
        yaw = math.radians(self.yaw)
        return np.array([math.sin(yaw), math.cos(yaw)])

    @property
    def right(self) -> Floats:
        yaw = math.radians(self.yaw)
        return np.array([math.cos(yaw), -math.sin(yaw)])

    @property
    def position(self) -> Floats:
        return np.array([self.x, self.y])

    def slopes(self, supersampling: int) -> Floats:
        """(columns,) lateral metres per metre of depth, at the middle of each column."""
        columns = (np.arange(self.width * supersampling) + 0.5) / supersampling
        return (columns - self.width / 2) / self.focal

    def horizons(self, supersampling: int) -> Floats:
        """(columns,) the row of the horizon in each column, in whole pixels."""
        lean = math.tan(math.radians(self.roll)) * self.focal
        return self.horizon * self.height + lean * self.slopes(supersampling)

    def project(self, points: Floats) -> tuple[Floats, Floats, Floats]:
        """(n, 3) metres (east, north, up) -> x and y in pixels, depth in metres."""
        away = points[:, :2] - self.position
        depth = away @ self.forward
        x = self.width / 2 + self.focal * (away @ self.right) / depth
        lean = math.tan(math.radians(self.roll)) * (x - self.width / 2)
        y = self.horizon * self.height + self.focal * (self.eye - points[:, 2]) / depth + lean
        return x, y, depth


@dataclass(frozen=True, slots=True)
class RayHits:
    """For each column the nearest plane: depth is infinite where there is none."""

    depth: Floats
    plane: NDArray[np.int64]
    """index into the planes that were cast against"""
    along: Floats
    """metres from the plane's start"""
    facing: Floats
    """metres towards the plane's normal per metre of depth"""


def cast_rays(
    camera: Camera, slopes: Floats, starts: Floats, directions: Floats, lengths: Floats
) -> RayHits:
    """Rays of the given slopes against vertical planes that are seen from their right side.

    starts and directions are (planes, 2), lengths (planes,). A plane that runs left to right as
    the camera sees it is seen; from behind it is not there.
    """
    rays = camera.forward + slopes[:, None] * camera.right  # (columns, 2)
    away = starts - camera.position
    across = rays[:, :1] * directions[:, 1] - rays[:, 1:] * directions[:, 0]  # (columns, planes)
    # The normal to the right of the direction is (d_y, -d_x): its product with the ray is `across`.
    seen = across < -1e-9
    safe = np.where(seen, across, -1.0)
    depth = (away[:, 0] * directions[:, 1] - away[:, 1] * directions[:, 0]) / safe
    along = (away[:, 0] * rays[:, 1:] - away[:, 1] * rays[:, :1]) / safe
    depth = np.where(seen & (depth > 0.3) & (along >= 0) & (along <= lengths), depth, np.inf)
    plane = depth.argmin(axis=1)
    rows = np.arange(len(slopes))
    return RayHits(
        depth=depth[rows, plane],
        plane=plane,
        along=np.clip(along[rows, plane], 0, lengths[plane]),
        facing=-across[rows, plane],
    )


MIP_LEVELS = 6
"""each half as fine as the one before"""
MIP_SIZE_FACTOR = 1.36
"""pixels of all levels per pixel of the first: 4 / 3, and what rounding up adds"""
SPARE_PIXELS = 6_000_000
"""more than all trees, vehicles and tiles of a catalogue take together"""

Packed = NDArray[np.uint32]


@dataclass(frozen=True, slots=True)
class MipmappedTexture:
    """Where one texture lies: one entry per level."""

    offsets: NDArray[np.int64]
    widths: NDArray[np.int64]
    """columns"""
    heights: NDArray[np.int64]
    """rows, which is also the distance between two columns"""


class TextureCache:
    """Textures by key; when it is full it forgets all of them and they are drawn again."""

    def __init__(self, capacity: int = 36_000_000) -> None:
        """`capacity` in pixels of 4 bytes; memory is taken as it is used."""
        self.pixels: Packed = np.zeros(capacity, np.uint32)
        self._used = 0
        self._kept: dict[Hashable, MipmappedTexture] = {}

    def reserve(self, textures: Mapping[Hashable, int]) -> None:
        """Forget everything unless the textures, by key with their pixels, fit beside the kept.

        Besides these, SPARE_PIXELS stay free for what is met later in the same photo: nothing may
        be forgotten while it is being read.
        """
        missing = sum(pixels for key, pixels in textures.items() if key not in self._kept)
        if self._used + missing * MIP_SIZE_FACTOR + SPARE_PIXELS > len(self.pixels):
            self._used = 0
            self._kept.clear()

    def get(self, key: Hashable, draw: Callable[[], Image.Image], *, rim: bool) -> MipmappedTexture:
        """The texture called `key`, drawn now if it is not kept.

        `rim` gives every level a see-through edge of one pixel, for what is seen on all sides.
        """
        if key not in self._kept:
            self._kept[key] = self._store(np.asarray(draw()), rim)
        return self._kept[key]

    def _store(self, picture: NDArray[np.uint8], rim: bool) -> MipmappedTexture:
        offsets, widths, heights = [], [], []
        for level in range(MIP_LEVELS):
            if level:
                picture = downsample(picture, careful=rim)
            stored = np.pad(picture, ((1, 1), (1, 1), (0, 0))) if rim else picture
            packed = np.ascontiguousarray(stored.transpose(1, 0, 2)).view(np.uint32).ravel()
            self.pixels[self._used : self._used + len(packed)] = packed
            offsets.append(self._used)
            heights.append(stored.shape[0])
            widths.append(stored.shape[1])
            self._used += len(packed)
        return MipmappedTexture(np.array(offsets), np.array(widths), np.array(heights))


def downsample(picture: NDArray[np.uint8], *, careful: bool) -> NDArray[np.uint8]:
    """(h, w, 4) -> (ceil(h / 2), ceil(w / 2), 4): mean colours, and one of the four codes.

    `careful` leaves see-through pixels out of the mean, as outlines against the sky need it.
    """
    if not careful:
        high, wide = picture.shape[:2]
        # As RGBX, so that Pillow takes the four bytes for four channels of equal rank.
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
"""canvas pixels per photo pixel, each way"""


@dataclass(slots=True)
class RenderBuffers:
    """What the lens sees before any light falls on it; (x, y) arrays."""

    canvas: Packed
    """(FINE * width, FINE * height) colours and codes, 0 where only sky is"""
    depth: NDArray[np.float32]
    """(width, height) metres, infinite for the sky"""
    sun: NDArray[np.float32]
    """(width, height) share of the sun's light that arrives"""
    lamp: NDArray[np.float32]
    """(width,) share of the street lamps' light, by night"""


def sample_texture(
    memory: TextureCache,
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
    """(columns, last - first) texels; `top` is the height of the texture's upper edge."""
    per_row = (scale * depth / camera.focal).astype(np.float32)
    horizon = camera.horizons(SUPERSAMPLING)[columns]
    start = (scale * (top - camera.eye) - per_row * horizon).astype(np.float32) + rim
    ys = ((np.arange(first, last) + 0.5) / SUPERSAMPLING).astype(np.float32)
    v = per_row[:, None] * ys
    v += start[:, None]
    np.clip(v, 0, (rows - 1)[:, None], out=v)
    index = v.astype(np.int32)
    index += offset.astype(np.int32)[:, None]
    return memory.pixels.take(index)


def choose_mip_level(
    finest: float, depth: NDArray[np.floating], camera: Camera, bias: float = 0.25
) -> NDArray[np.int64]:
    """Which smaller copy to read, so that about one texel falls on one canvas pixel."""
    texels = finest * depth / (camera.focal * SUPERSAMPLING)
    return np.asarray(np.clip(np.log2(np.maximum(texels, 1.0)) + bias, 0, MIP_LEVELS - 1), np.int64)


def project_row(camera: Camera, z: float, depth: Floats, columns: NDArray[np.int64]) -> Floats:
    """Canvas row of the height z at the columns' depths."""
    horizon = camera.horizons(SUPERSAMPLING)[columns]
    return np.asarray((horizon + camera.focal * (camera.eye - z) / depth) * SUPERSAMPLING)
