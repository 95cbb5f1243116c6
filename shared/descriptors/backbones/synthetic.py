"""Synthetic backbones without weights, for tests and load measurements.

`TinyBackbone` is deterministic and fast: a patch's feature is a fixed random projection of its
4 x 4 pixels. Maps accept it only with ALLOW_TEST_EXTRACTORS, because it recognises no places.

`SlowBackbone` sleeps for a configured time per photo without using the CPU, to measure the system
around the model. A photo has one feature, a fixed selection of `width` of its pixels, so that
similar photos have similar descriptors.
"""

from __future__ import annotations

import hashlib
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from shared.descriptors.backbones import Backbone, normalise_features
from shared.extractor_config.configs import SLOW_TEST_BACKBONE, ExtractorConfig

TINY_SEED = 20_240
TINY_PATCH_PIXELS = 4  # pixels


class TinyBackbone(Backbone):
    """Backbone that projects patches of 4 x 4 pixels by a fixed random matrix."""

    name = "test-tiny"
    licence = "MIT"
    width = 16
    layer = "projection"

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

    @classmethod
    def load(
        cls, config: ExtractorConfig, device: torch.device, weights: Path | None
    ) -> TinyBackbone:
        return cls(device)

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


class SlowBackbone(Backbone):
    """Backbone that selects pixels and sleeps for a given time per photo."""

    name = SLOW_TEST_BACKBONE
    licence = "MIT"
    layer = "pixels"

    def __init__(self, width: int, seconds: float, device: torch.device) -> None:
        """`width`: number of selected pixels; `seconds`: time to sleep for each photo."""
        fractions = np.random.default_rng(SLOW_SEED).random(width, dtype=np.float32)
        self.fingerprint = hashlib.sha256(fractions.tobytes()).hexdigest()
        self.card: dict[str, Any] = {"made": "a fixed choice of pixels, no training"}
        self.width = width
        self.device = device
        self._seconds = seconds
        self._fractions = torch.from_numpy(fractions).to(device)

    @classmethod
    def load(
        cls, config: ExtractorConfig, device: torch.device, weights: Path | None
    ) -> SlowBackbone:
        assert config.width is not None
        return cls(config.width, config.milliseconds / 1000, device)

    @torch.inference_mode()
    def features(self, pixels: torch.Tensor) -> torch.Tensor:
        time.sleep(self._seconds * len(pixels))
        flat = pixels.to(self.device).flatten(1)
        # A fraction below 1 may still be rounded up to the full length.
        chosen = (self._fractions * flat.shape[1]).long().clamp(max=flat.shape[1] - 1)
        # No pixel has the value 127.5, so no feature is zero.
        values = flat[:, chosen].to(torch.float32) - 127.5
        return normalise_features(values).unsqueeze(1)
