"""Backbones: networks that compute dense patch features of photos.

Each module of this package implements `Backbone` for one kind of network. The configurations of
`shared.extractor_config` name its class, so that a new one needs no other registration.
"""

from __future__ import annotations

import pkgutil
from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, Self

import torch
from torch.nn.functional import normalize

from shared.descriptors.weight_files import OnProgress
from shared.errors import PlacewiseError
from shared.extractor_config.configs import MAX_WIDTH, ExtractorConfig
from shared.extractor_config.names import NetworkInput
from shared.imaging.preprocessing import Preprocessing

MIN_NORM = 1e-12  # shorter features are noise and are not scaled up to length 1
PROBE_SEED = 20_242
MIN_REPEAT_COSINE = 0.999  # of a photo alone and in a batch; kernels differ slightly


class StoredWeights(NamedTuple):
    """Weights that were found on this machine, without loading them."""

    path: Path
    licence: str


class Backbone(ABC):
    """A pretrained network that computes patch features of a batch of photos."""

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
    facet: str | None = None
    """query, key, value or token of a transformer layer; None for other networks."""
    device: torch.device
    """Where `features` computes and where its result is."""
    preprocessing: Preprocessing | None = None
    """The network's own, if its configuration leaves it open."""

    def own_spec(self) -> dict[str, Any]:
        """Return the fields that the backbone adds to the extractor spec (JSON)."""
        return {}

    @classmethod
    @abstractmethod
    def load(cls, config: ExtractorConfig, device: torch.device, weights: Path | None) -> Backbone:
        """Load the weights onto a device.

        Args:
            weights: The setting DINO_WEIGHTS, for DINOv2; None for the published weights.

        Raises:
            Misconfigured: `weights_missing`, `weights_unusable`, and others of the network.
        """

    @classmethod
    def weights_source(cls, config: ExtractorConfig, weights: Path | None) -> str:
        """Return where the weights come from, in words."""
        raise NotImplementedError

    @classmethod
    def find_weights(cls, config: ExtractorConfig, weights: Path | None) -> StoredWeights:
        """Find the weights on this machine, without network access, and check that they fit.

        Raises:
            Misconfigured: `weights_missing`, `weights_unusable`.
        """
        raise NotImplementedError

    @classmethod
    def fetch(
        cls, config: ExtractorConfig, weights: Path | None, on_progress: OnProgress
    ) -> Self | None:
        """Download what is missing; return the backbone if that has loaded it."""
        return None

    @abstractmethod
    def features(self, pixels: torch.Tensor) -> torch.Tensor:
        """Compute the patch features of a batch of photos.

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
        return 1, 1


class NetworkBackbone(Backbone):
    """Backbone of a network that computes one descriptor of a photo, (B, D)."""

    network: Callable[[torch.Tensor], Any]
    """Of a batch as `expected` says; of a tuple of results, the first is the descriptor."""
    expected: NetworkInput

    @torch.inference_mode()
    def features(self, pixels: torch.Tensor) -> torch.Tensor:
        features = normalise_features(self._forward(pixels))
        return features.unsqueeze(1) if features.ndim == 2 else features

    def _forward(self, pixels: torch.Tensor) -> Any:
        out = self.network(to_network_input(pixels.to(self.device), self.expected))
        return out[0] if isinstance(out, tuple | list) and out else out

    @torch.inference_mode()
    def probe(self, height: int, width: int) -> tuple[Any, Any]:
        """Return what `find_descriptor_fault` checks: for two images of noise, and for the first.

        Raises ValueError with a reason if the network raises anything but a PlacewiseError.
        """
        photos = probe_photos(height, width)
        try:
            return self._forward(photos), self._forward(photos[:1])
        except PlacewiseError:
            raise
        except Exception as error:  # networks of others may raise anything
            reason = (str(error).strip() or "no message").splitlines()[-1]  # after a traceback
            raise ValueError(
                f"with 2 photos of {height} x {width} pixels it fails with "
                f"{type(error).__name__}: {reason}"
            ) from error


def backbone_class(config: ExtractorConfig) -> type[Backbone]:
    """Import the class of a configuration's backbone."""
    found: type[Backbone] = pkgutil.resolve_name(f"{__name__}.{config.implementation}")
    return found


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


def to_network_input(pixels: torch.Tensor, expected: NetworkInput) -> torch.Tensor:
    """Convert (B, H, W, 3) uint8 pixels to the range and layout that a network expects."""
    if expected.range is None:
        batch = normalise_pixels(pixels, expected.mean, expected.std)
    else:
        batch = pixels.permute(0, 3, 1, 2)
        if expected.range != "uint8":
            batch = batch.float() / (255.0 if expected.range == "1" else 1.0)
    return batch.permute(0, 2, 3, 1) if expected.layout == "nhwc" else batch


def probe_photos(height: int, width: int) -> torch.Tensor:
    """Return two images of noise, (2, height, width, 3) uint8."""
    noise = torch.Generator().manual_seed(PROBE_SEED)
    return torch.randint(0, 256, (2, height, width, 3), dtype=torch.uint8, generator=noise)


def find_descriptor_fault(both: Any, alone: Any) -> str | None:
    """Return why a network computes no descriptors; None if it does.

    Args:
        both: Its result for `probe_photos`, expected (2, D).
        alone: Its result for the first of them, expected (1, D).
    """
    if not isinstance(both, torch.Tensor) or not both.is_floating_point():
        kind = f"tensor of {both.dtype}" if isinstance(both, torch.Tensor) else type(both).__name__
        return f"it returns a {kind}, not a tensor of floats"
    if both.ndim != 2 or len(both) != 2 or alone.shape != (1, both.shape[1]):
        return (
            f"for 2 photos it returns the shape {tuple(both.shape)}, for one "
            f"{tuple(alone.shape)}; expected one descriptor per photo: (2, D) and (1, D)"
        )
    if both.shape[1] > MAX_WIDTH:
        return f"{both.shape[1]} dimensions exceed the maximum of {MAX_WIDTH}"
    if not torch.isfinite(both).all() or not torch.isfinite(alone).all():
        return "its descriptors hold NaN or infinite numbers"
    if bool((both.norm(dim=-1) == 0).any()):
        return "its descriptors are zero"
    cosine = float(normalize(both[:1].float(), dim=-1) @ normalize(alone[0].float(), dim=-1))
    if cosine < MIN_REPEAT_COSINE:
        return (
            "the descriptor of a photo depends on the other photos of its batch (cosine "
            f"{cosine:.3f}), and the composition of batches varies"
        )
    return None
