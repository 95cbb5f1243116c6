"""A model of `placewise train` as a backbone: it makes one global descriptor of a photo.

Photos are brought to the model's image size as they were for the figures of its evaluations:
upright, bilinear, antialiased, whatever the aspect (`resizeHEIGHTxWIDTH` in
`shared.imaging.preprocessing`), then normalised by ImageNet's mean and deviation.
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
from shared.imaging.preprocessing import Preprocessing, get_preprocessing

PROBE_SEED = 20_242
MIN_REPEAT_COSINE = 0.999  # of a photo described alone and beside another; kernels differ a little


class TrainedBackbone:
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
        """`name` as in `gsv:N`; `fingerprint` of configuration and weights."""
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
        """The model in a checkpoint of this machine; raises as `load_checkpoint` and `check`."""
        found = load_checkpoint(path)
        card = {"source": path.name, **found.about}
        made = cls(name, found.model, found.fingerprint, device, licence="not said", card=card)
        made.check()
        return made

    @property
    def image_size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        return self._model.config.image_size

    @property
    def preprocessing(self) -> Preprocessing:
        return get_preprocessing("resize{}x{}".format(*self.image_size))

    def as_spec(self) -> dict[str, Any]:
        """What the network is shown, beside what every extractor's spec says."""
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
        """Describe two pictures of noise; Unprocessable (`model_unfit`) for weights that make no
        descriptors."""
        for name, tensor in self._model.state_dict().items():
            if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
                raise _model_unfit_error(f"its weights {name} hold NaN or infinite numbers")
        if self.width > MAX_WIDTH:
            raise _model_unfit_error(f"{self.width} dimensions are more than {MAX_WIDTH}")
        noise = torch.Generator().manual_seed(PROBE_SEED)
        shape = (2, *self.image_size, 3)
        photos = torch.randint(0, 256, shape, dtype=torch.uint8, generator=noise)
        both, alone = self._forward(photos), self._forward(photos[:1])
        if both.shape != (2, self.width) or alone.shape != (1, self.width):
            raise _model_unfit_error(
                f"of 2 photos it makes numbers of the shape {tuple(both.shape)}"
            )
        if not torch.isfinite(both).all() or not torch.isfinite(alone).all():
            raise _model_unfit_error("its descriptors hold NaN or infinite numbers")
        if bool((both.norm(dim=-1) == 0).any()) or torch.equal(both[0], both[1]):
            raise _model_unfit_error(
                "of two different photos its descriptors are zero, or the same"
            )
        cosine = float(normalise_features(both[0]) @ normalise_features(alone[0]))
        if cosine < MIN_REPEAT_COSINE:
            raise _model_unfit_error(
                "it describes a photo otherwise when another one is beside it (cosine "
                f"{cosine:.3f}), and which ones are described together is chance here"
            )


def _model_unfit_error(fault: str) -> Unprocessable:
    return Unprocessable("model_unfit", f"The model can't describe photos: {fault}.")
