"""Backbone of models from `placewise train`: computes one global descriptor per photo.

Photos are resized to the model's image size as in its evaluations: upright, antialiased, ignoring
the aspect ratio (`squeeze_name` in `shared.imaging.preprocessing`), then normalised by ImageNet's
mean and standard deviation.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from shared.descriptors.backbones import normalise_features, normalise_pixels
from shared.descriptors.vpr_models.checkpoint import load_checkpoint
from shared.descriptors.vpr_models.model import VprModel
from shared.errors import Unprocessable
from shared.extractor_config.configs import MAX_WIDTH
from shared.extractor_config.names import IMAGENET_MEAN, IMAGENET_STD
from shared.imaging.preprocessing import Preprocessing, get_preprocessing, squeeze_name

PROBE_SEED = 20_242
MIN_REPEAT_COSINE = 0.999  # of a photo alone and in a batch; kernels differ slightly


class TrainedBackbone:
    """Backbone that runs a `VprModel`; one feature per photo."""

    facet: str | None = None

    def __init__(
        self,
        name: str,
        model: VprModel,
        fingerprint: str,
        device: torch.device,
        *,
        licence: str,
        card: dict[str, Any],
    ) -> None:
        """Wrap a loaded model.

        Args:
            name: The extractor's name, as in `gsv:N`.
            fingerprint: Hash of configuration and weights.
            card: Model card: where the weights come from.
        """
        self.name = name
        self.fingerprint = fingerprint
        self.licence = licence
        self.card = card
        self.device = device
        self.layer = model.config.agg_arch
        self.width = model.dimension
        self._model = model.eval().requires_grad_(False).to(device)

    @classmethod
    def from_checkpoint(cls, name: str, path: Path, device: torch.device) -> TrainedBackbone:
        """Load and check a local checkpoint; raises as `load_checkpoint` and `check`."""
        checkpoint = load_checkpoint(path)
        card = {"source": path.name, **checkpoint.about}
        backbone = cls(
            name,
            checkpoint.model,
            checkpoint.fingerprint,
            device,
            licence="not stated",
            card=card,
        )
        backbone.check()
        return backbone

    @property
    def image_size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        return self._model.config.image_size

    @property
    def preprocessing(self) -> Preprocessing:
        """The resize to the model's image size."""
        return get_preprocessing(squeeze_name(self.image_size, self._model.config.interpolation))

    def as_spec(self) -> dict[str, Any]:
        """Return the fields that the model adds to the extractor spec: its input (JSON)."""
        return {
            "image_size": list(self.image_size),
            "normalisation": {"mean": list(IMAGENET_MEAN), "std": list(IMAGENET_STD)},
        }

    @torch.inference_mode()
    def features(self, pixels: torch.Tensor) -> torch.Tensor:
        return normalise_features(self._forward(pixels)).unsqueeze(1)

    def grid(self, height: int, width: int) -> tuple[int, int]:
        return 1, 1

    def _forward(self, pixels: torch.Tensor) -> torch.Tensor:
        batch = normalise_pixels(pixels.to(self.device), IMAGENET_MEAN, IMAGENET_STD)
        rows: torch.Tensor = self._model(batch)
        return rows

    @torch.inference_mode()
    def check(self) -> None:
        """Check the weights, and the descriptors of two images of noise.

        Raises Unprocessable (`model_unusable`).
        """
        for name, tensor in self._model.state_dict().items():
            if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
                raise _model_unusable_error(f"its weights {name} contain NaN or infinite numbers")
        if self.width > MAX_WIDTH:
            raise _model_unusable_error(
                f"{self.width} dimensions exceed the maximum of {MAX_WIDTH}"
            )
        noise = torch.Generator().manual_seed(PROBE_SEED)
        shape = (2, *self.image_size, 3)
        photos = torch.randint(0, 256, shape, dtype=torch.uint8, generator=noise)
        both, alone = self._forward(photos), self._forward(photos[:1])
        if both.shape != (2, self.width) or alone.shape != (1, self.width):
            raise _model_unusable_error(f"for 2 photos it returns the shape {tuple(both.shape)}")
        if not torch.isfinite(both).all() or not torch.isfinite(alone).all():
            raise _model_unusable_error("its descriptors hold NaN or infinite numbers")
        if bool((both.norm(dim=-1) == 0).any()) or torch.equal(both[0], both[1]):
            raise _model_unusable_error("its descriptors of two different photos are zero or equal")
        cosine = float(normalise_features(both[0]) @ normalise_features(alone[0]))
        if cosine < MIN_REPEAT_COSINE:
            raise _model_unusable_error(
                "the descriptor of a photo depends on the other photos of its batch (cosine "
                f"{cosine:.3f}), and the composition of batches varies"
            )


def _model_unusable_error(reason: str) -> Unprocessable:
    return Unprocessable("model_unusable", f"The model can't describe photos: {reason}.")
