"""A deterministic backbone without weights, for tests of everything around the model.

Each patch's feature is a fixed random projection of its 4 x 4 pixels. It knows nothing of places
beyond their pixels, so maps refuse it unless ALLOW_TEST_EXTRACTORS is set.

A deterministic backbone that takes time without taking CPU, for measuring what is around it.

A photo's one feature is a fixed choice of its pixels, as many as are asked for: two photos are as
near as their pixels are.
"""

from __future__ import annotations

import hashlib
import time
from typing import Any

import numpy as np
import torch

from shared.descriptors.backbones import normalise_features
from shared.extractor_config.configs import SLOW_TEST_BACKBONE

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


SLOW_SEED = 20_241


class SlowBackbone:
    name = SLOW_TEST_BACKBONE
    licence = "MIT"
    layer = "pixels"
    facet: str | None = None

    def __init__(self, width: int, seconds: float, device: torch.device) -> None:
        """`seconds` are slept for each photo."""
        places = np.random.default_rng(SLOW_SEED).random(width, dtype=np.float32)
        self.fingerprint = hashlib.sha256(places.tobytes()).hexdigest()
        self.card: dict[str, Any] = {"made": "a fixed choice of pixels, no training"}
        self.width = width
        self.device = device
        self._seconds = seconds
        self._places = torch.from_numpy(places).to(device)

    @torch.inference_mode()
    def features(self, pixels: torch.Tensor) -> torch.Tensor:
        time.sleep(self._seconds * len(pixels))
        flat = pixels.to(self.device).flatten(1)
        # A share below 1 may still be rounded up to the whole length.
        chosen = (self._places * flat.shape[1]).long().clamp(max=flat.shape[1] - 1)
        # The middle of the range is no pixel's value: every photo has a direction.
        values = flat[:, chosen].to(torch.float32) - 127.5
        return normalise_features(values).unsqueeze(1)

    def grid(self, height: int, width: int) -> tuple[int, int]:
        return 1, 1
