"""Backbone of models from `placewise train`: computes one global descriptor per photo.

Photos are resized to the model's image size as in its evaluations: upright, antialiased, ignoring
the aspect ratio (`squeeze_name` in `shared.imaging.preprocessing`), then normalised by ImageNet's
mean and standard deviation.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from shared.descriptors.backbones import NetworkBackbone, find_descriptor_fault
from shared.descriptors.vpr_models.checkpoint import load_checkpoint
from shared.descriptors.vpr_models.model import VprModel
from shared.errors import Unprocessable
from shared.extractor_config.configs import ExtractorConfig
from shared.extractor_config.names import DEFAULT_INPUT, IMAGENET_MEAN, IMAGENET_STD
from shared.imaging.preprocessing import get_preprocessing, squeeze_name


class TrainedBackbone(NetworkBackbone):
    """Backbone that runs a `VprModel`; one feature per photo."""

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
        self.network, self.expected = self._model, DEFAULT_INPUT
        self.image_size = model.config.image_size
        """Height and width in pixels."""
        self.preprocessing = get_preprocessing(
            squeeze_name(self.image_size, model.config.interpolation)
        )

    def own_spec(self) -> dict[str, Any]:
        return {
            "image_size": list(self.image_size),
            "normalisation": {"mean": list(IMAGENET_MEAN), "std": list(IMAGENET_STD)},
        }

    @classmethod
    def load(
        cls, config: ExtractorConfig, device: torch.device, weights: Path | None
    ) -> TrainedBackbone:
        """Load and check a local checkpoint; raises as `load_checkpoint` and `check`."""
        assert config.model is not None
        assert config.model.file is not None, "a registered model is loaded through the catalog"
        path = Path(config.model.file)
        loaded = load_checkpoint(path)
        card = {"source": path.name, **loaded.about}
        backbone = cls(
            config.name, loaded.model, loaded.fingerprint, device, licence="not stated", card=card
        )
        backbone.check()
        return backbone

    def check(self) -> None:
        """Check the weights, and the descriptors of two images of noise.

        Raises Unprocessable (`model_unusable`).
        """
        for name, tensor in self._model.state_dict().items():
            if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
                raise _model_unusable_error(f"its weights {name} contain NaN or infinite numbers")
        both, alone = self.probe(*self.image_size)
        fault = find_descriptor_fault(both, alone)
        if fault is None and torch.equal(both[0], both[1]):
            fault = "its descriptors of two different photos are equal"
        if fault is not None:
            raise _model_unusable_error(fault)


def _model_unusable_error(reason: str) -> Unprocessable:
    return Unprocessable("model_unusable", f"The model can't describe photos: {reason}.")
