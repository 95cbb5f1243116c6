"""All textures of a drawing process in one flat array, each with its smaller copies.

One flat array lets a single gather read, for every column of a photo, from another texture at
another size. Textures lie column by column, so that a photo's column reads neighbouring memory.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image

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
