"""A photo's local features with their places, and how they are kept.

    <generation>/<photo>.npy     (rows, columns, D) float16, little-endian, C order

Two bytes a number: 44 kB with EfficientNet-Lite0 at 224 px (196 patches of 112), 786 kB with
DINOv2's ViT-g there (256 of 1,536), 4.7 MB at 480 x 640. Rounding moves a cosine by less than
0.001. Comparisons always round, so that an answer does not depend on what was kept.
"""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from shared.vision.vocabulary import ARRAY_READ_ERRORS

FLOAT16 = np.dtype("<f2")


@dataclass(frozen=True, slots=True, eq=False)
class LocalFeatures:
    """(rows, columns, D) float16, each patch of length 1 (or 0) but for rounding."""

    array: NDArray[np.float16]

    @classmethod
    def from_features(cls, features: torch.Tensor, grid: tuple[int, int]) -> LocalFeatures:
        """(patches, D) float32 on the CPU, row by row of the grid (rows, columns)."""
        return cls(features.numpy().astype(FLOAT16).reshape(*grid, -1))

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.array.shape[0], self.array.shape[1]

    @property
    def finite(self) -> bool:
        return bool(np.isfinite(self.array).all())

    def patches(self, device: torch.device) -> torch.Tensor:
        """(patches, D) float32."""
        flat = self.array.reshape(-1, self.array.shape[2]).astype(np.float32)
        return torch.from_numpy(flat).to(device)

    def encode(self) -> bytes:
        buffer = io.BytesIO()
        np.save(buffer, self.array, allow_pickle=False)
        return buffer.getvalue()

    @classmethod
    def decode(cls, data: bytes, width: int) -> LocalFeatures:
        """What `encode` has made; ValueError for anything else, and for another width than D."""
        try:
            array = np.load(io.BytesIO(data), allow_pickle=False)
        except ARRAY_READ_ERRORS as error:
            raise ValueError(f"no array: {error}") from error
        if array.dtype != FLOAT16 or array.ndim != 3 or array.shape[2] != width or not array.size:
            raise ValueError(
                f"{array.dtype} of {array.shape}, not float16 (rows, columns, {width})"
            )
        return cls(array)
