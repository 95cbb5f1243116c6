"""Backbones: networks that compute dense local features of photos.

`Backbone` is the interface; each module of this package implements it for one kind of network.
"""

from __future__ import annotations

from typing import Any, Protocol

import torch

MIN_NORM = 1e-12  # shorter features are noise and are not scaled up to length 1


class Backbone(Protocol):
    """A pretrained network that computes local features of a batch of photos."""

    name: str
    fingerprint: str
    """sha256 of the weights."""
    licence: str
    card: dict[str, Any]
    """Model card: where the weights come from (JSON)."""
    width: int
    """Length of one local feature."""
    layer: str
    """Name or number of the layer that the features are taken from."""
    facet: str | None
    """query, key, value or token of a transformer layer; None for other networks."""
    device: torch.device
    """Where `features` computes and where its result is."""

    def features(self, pixels: torch.Tensor) -> torch.Tensor:
        """Compute the local features of a batch of photos.

        Args:
            pixels: (B, H, W, 3) RGB, 0 to 255; uint8, or float32 if the preprocessing does not
                round. They are normalised by channel here, not by the caller.

        Returns:
            (B, patches, width) float32, each patch L2-normalised. A patch whose feature is zero
            stays zero. A feature that is not finite, or whose length overflows, is NaN.
        """

    def grid(self, height: int, width: int) -> tuple[int, int]:
        """Return rows and columns of the patches of a photo of `height` x `width` pixels.

        `features` returns the patches row by row. (1, 1) for one feature of the whole photo.
        """


def normalise_features(features: torch.Tensor) -> torch.Tensor:
    """L2-normalise (..., width) features of any floating type to float32.

    A feature whose length overflows becomes NaN, so that its photo is rejected: dividing by the
    infinite length would give zeros, which aggregators take for a patch without structure.
    """
    features = features.float()
    lengths = torch.linalg.vector_norm(features, dim=-1, keepdim=True)
    lengths = torch.where(lengths.isfinite(), lengths, torch.nan)
    return features / lengths.clamp(min=MIN_NORM)


def normalise_pixels(
    pixels: torch.Tensor, mean: tuple[float, ...], std: tuple[float, ...]
) -> torch.Tensor:
    """Convert (B, H, W, 3) in 0 to 255 to (B, 3, H, W) float32, ((x / 255) - mean) / std."""
    scaled = pixels.permute(0, 3, 1, 2).to(torch.float32) / 255.0
    shape = (1, 3, 1, 1)
    centre = torch.tensor(mean, device=pixels.device).view(shape)
    return (scaled - centre) / torch.tensor(std, device=pixels.device).view(shape)


__all__ = ["Backbone"]
