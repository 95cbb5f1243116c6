"""A deterministic backbone without weights, for tests of everything around the model.

Each patch's feature is a fixed random projection of its 4 x 4 pixels. It knows nothing of places
beyond their pixels, so maps refuse it unless ALLOW_TEST_EXTRACTORS is set.
"""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
import torch

from shared.vision.backbones.base import normalise_features

TINY_SEED = 20_240
TINY_PATCH_PIXELS = 4  # pixels


class TinyBackbone:
    name = "test-tiny"
    licence = "MIT"
    width = 16
    layer = "projection"
    facet: str | None = None

    def __init__(self, device: torch.device) -> None:
        projection = (
            np.random.default_rng(TINY_SEED)
            .standard_normal((TINY_PATCH_PIXELS * TINY_PATCH_PIXELS * 3, self.width))
            .astype(np.float32)
        )
        self.fingerprint = hashlib.sha256(projection.tobytes()).hexdigest()
        self.card: dict[str, Any] = {"made": "a fixed random projection, no training"}
        self._projection = torch.from_numpy(projection).to(device)
        self.device = device

    @torch.inference_mode()
    def features(self, pixels: torch.Tensor) -> torch.Tensor:
        images = pixels.to(self.device).permute(0, 3, 1, 2).to(torch.float32) / 127.5 - 1.0
        patches = torch.nn.functional.unfold(
            images, TINY_PATCH_PIXELS, stride=TINY_PATCH_PIXELS
        ).transpose(1, 2)
        return normalise_features(patches @ self._projection)

    def grid(self, height: int, width: int) -> tuple[int, int]:
        return height // TINY_PATCH_PIXELS, width // TINY_PATCH_PIXELS
