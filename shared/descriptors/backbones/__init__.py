"""Backbones: pixels to dense local features. One module per backbone behind one small class.

What every backbone offers, whatever network is inside.
"""

from __future__ import annotations

from typing import Any, Protocol

import torch

MIN_NORM = 1e-12  # what is shorter is not scaled up to 1: it has no direction but noise


class Backbone(Protocol):
    """Turns a batch of photos into dense local features."""

    name: str
    fingerprint: str
    """sha256 of the weights."""
    licence: str
    card: dict[str, Any]
    """Where the weights come from."""
    width: int
    """Length of one local feature."""
    layer: str
    """The point of the network that the features are taken from."""
    facet: str | None
    """query, key, value or token of a transformer layer; None for other networks."""
    device: torch.device
    """Where `features` runs and where its answer lies."""

    def features(self, pixels: torch.Tensor) -> torch.Tensor:
        """(B, H, W, 3) RGB, 0 to 255 -> (B, patches, width) float32, each patch L2-normalised.

        `pixels` are uint8, or float32 where a preprocessing left them unrounded; they are
        normalised by channel here, and nowhere before.

        A patch whose feature is zero stays zero. What is not finite, or too large for its length to
        be, is NaN.
        """

    def grid(self, height: int, width: int) -> tuple[int, int]:
        """Rows and columns of the patches of a photo of so many pixels; `features` has them row by
        row. (1, 1) where there is one feature of the whole photo."""


def normalise_features(features: torch.Tensor) -> torch.Tensor:
    """(..., width) of any floating type -> float32 of length 1, as `Backbone.features` promises.

    Dividing by a length that has overflowed would make zeros, which aggregators take for a patch
    without any structure: such a patch is NaN, and its photo is refused.
    """
    features = features.float()
    lengths = torch.linalg.vector_norm(features, dim=-1, keepdim=True)
    lengths = torch.where(lengths.isfinite(), lengths, torch.nan)
    return features / lengths.clamp(min=MIN_NORM)


def normalise_pixels(
    pixels: torch.Tensor, mean: tuple[float, ...], std: tuple[float, ...]
) -> torch.Tensor:
    """(B, H, W, 3), 0 to 255 -> (B, 3, H, W) float32, ((x / 255) - mean) / std by channel."""
    scaled = pixels.permute(0, 3, 1, 2).to(torch.float32) / 255.0
    shape = (1, 3, 1, 1)
    centre = torch.tensor(mean, device=pixels.device).view(shape)
    return (scaled - centre) / torch.tensor(std, device=pixels.device).view(shape)


__all__ = ["Backbone"]
