"""The canvas that one photo is painted on, and reading textures onto its columns.

It is twice as fine as the photo and lies column by column (the first axis is x): a vertical plane
is linear in a column, so that one multiply and one gather fill all columns at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shared.datasets.city.camera import Camera, Floats
from shared.datasets.city.texture_memory import MIP_LEVELS, Packed, TextureCache

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
