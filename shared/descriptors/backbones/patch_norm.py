"""Patch-normalised thumbnails: descriptors of aligned rides, without weights.

A small grey photo is divided into patches, each of which is shifted to the mean 0 and scaled to the
standard deviation 1 (Milford and Wyeth 2012, "SeqSLAM: Visual route-based navigation for sunny
summer days and stormy winter nights"). The cosine of two rows takes the place of their sum of
absolute differences. Photos are similar if they were taken at the same position and in the same
direction.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import torch

from shared.descriptors.backbones import Backbone, StoredWeights, normalise_features
from shared.extractor_config.configs import ExtractorConfig

PATCH = 4  # pixels; the side of a patch
MIN_STD = 64.0
"""Standard deviation in grey levels; a patch below is noise and is not scaled up to 1"""


class PatchNorm(Backbone):
    """Backbone whose one feature of a photo is its patch-normalised thumbnail."""

    name = "patchnorm"
    licence = "MIT"
    layer = "pixels"
    fingerprint = hashlib.sha256(f"patchnorm {PATCH} {MIN_STD}".encode()).hexdigest()

    def __init__(self, width: int, device: torch.device) -> None:
        """`width`: number of pixels of a thumbnail."""
        self.card: dict[str, Any] = {"made": "grey levels, normalised in patches; no training"}
        self.width = width
        self.device = device

    @classmethod
    def load(cls, config: ExtractorConfig, device: torch.device, weights: Path | None) -> PatchNorm:
        assert config.width is not None
        return cls(config.width, device)

    @classmethod
    def weights_source(cls, config: ExtractorConfig, weights: Path | None) -> str:
        return "none: it has no weights"

    @classmethod
    def find_weights(cls, config: ExtractorConfig, weights: Path | None) -> StoredWeights:
        return StoredWeights(Path(__file__), cls.licence)

    @torch.inference_mode()
    def features(self, pixels: torch.Tensor) -> torch.Tensor:
        grey = pixels.to(self.device, torch.float32).mean(dim=-1)
        patches = grey.unfold(1, PATCH, PATCH).unfold(2, PATCH, PATCH)
        std, mean = torch.std_mean(patches, dim=(-2, -1), correction=0, keepdim=True)
        normalised = (patches - mean) / std.clamp(min=MIN_STD)
        return normalise_features(normalised.flatten(1)).unsqueeze(1)
