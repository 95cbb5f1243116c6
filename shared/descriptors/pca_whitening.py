"""PCA whitening of descriptors: projection and file format.

As in Jegou and Chum (Negative evidences and co-occurrences in image retrieval, ECCV 2012), and as
AnyLoc's PCA rows (RA-L 2023: whitened, then L2-normalised again). For n database rows x_i with mean
m, centred to X (n x D), with the d largest variances l_1 >= ... >= l_d of their covariance
X'X / (n - 1) and the unit directions p_j:

    y_j = <p_j, x - m> / sqrt(l_j)          row = y / |y|

`shared.descriptors.pca_fit` computes mean and directions.

Files are safetensors. `spec` in the header's `__metadata__`, a string of JSON, is the extractor
spec (`Extractor.spec`) of the rows that the whitening was fitted on.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save
from torch.nn.functional import normalize

from shared.errors import Unprocessable

Rows = NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class PcaWhitening:
    """A fitted PCA whitening from D to d dimensions."""

    mean: NDArray[np.float32]
    """(D,) mean of the rows."""
    directions: NDArray[np.float32]
    """(d, D): each unit direction divided by its standard deviation."""
    variances: NDArray[np.float32]
    """(d,) variances of the rows along the directions, largest first."""
    explained: float
    """Explained variance ratio of all d directions together, 0 to 1."""
    rows: int
    """Number of rows that it was fitted on."""

    @property
    def dimension(self) -> int:
        """Length of a descriptor before."""
        return int(self.directions.shape[1])

    @property
    def components(self) -> int:
        """Length of a descriptor after."""
        return int(self.directions.shape[0])

    @property
    def sha256(self) -> str:
        """Hash of the mean and the directions, which determine the projection."""
        digest = hashlib.sha256(np.ascontiguousarray(self.mean).data)
        digest.update(np.ascontiguousarray(self.directions).data)
        return digest.hexdigest()


class PcaProjection:
    """Applies a whitening on a device."""

    def __init__(self, whitening: PcaWhitening, device: torch.device) -> None:
        self.dimension = whitening.dimension
        """Length of a descriptor before."""
        self.components = whitening.components
        """Length of a descriptor after."""
        self.sha256 = whitening.sha256
        self._mean = _tensor(whitening.mean).to(device)
        self._directions = _tensor(whitening.directions).to(device)

    @torch.inference_mode()
    def __call__(self, rows: torch.Tensor) -> torch.Tensor:
        """Project (B, dimension) float32 rows on the device to (B, components) unit rows.

        A zero row (a photo without structure) stays zero: it was similar to no photo, and must not
        become similar to rows at the same distance from the mean. A row equal to the mean becomes
        zero, too.
        """
        whitened = normalize((rows - self._mean) @ self._directions.T, dim=-1)
        return torch.where(rows.any(dim=-1, keepdim=True), whitened, 0)

    def project(self, rows: Rows) -> Rows:
        """Project NumPy rows, as `__call__` does."""
        projected: Rows = self(_tensor(rows).to(self._mean.device)).cpu().numpy()
        return projected


def _tensor(array: Rows) -> torch.Tensor:
    # Arrays over a file's bytes are read-only, which torch does not support.
    return torch.from_numpy(np.require(array, requirements=["C", "W"]))


# Fields that change only the last bits of a descriptor; a whitening stays valid.
IGNORED_SPEC_FIELDS = ("decoder", "precision")


@dataclass(frozen=True, slots=True, eq=False)
class PcaWhiteningFile:
    """A whitening with the extractor spec of the rows that it was fitted on."""

    whitening: PcaWhitening
    spec: dict[str, Any]
    """Extractor spec of those rows."""

    def encode(self) -> bytes:
        """Encode as a `.safetensors` file."""
        whitening = self.whitening
        return save(
            {
                "mean": np.ascontiguousarray(whitening.mean),
                "directions": np.ascontiguousarray(whitening.directions),
                "variances": np.ascontiguousarray(whitening.variances),
                "explained": np.array([whitening.explained], dtype=np.float64),
                "rows": np.array([whitening.rows], dtype=np.int64),
            },
            {"spec": json.dumps(self.spec, sort_keys=True)},
        )

    def check_compatible(self, spec: dict[str, Any]) -> None:
        """Check that the whitening was fitted on descriptors of the extractor spec `spec`.

        `spec` is that of descriptors before projection.

        Raises Unprocessable (`pca_unusable`) naming the differences.
        """
        differing = [
            f"{key} is {spec.get(key)!r}, was {self.spec.get(key)!r}"
            for key in sorted(spec.keys() | self.spec.keys())
            if key not in IGNORED_SPEC_FIELDS and spec.get(key) != self.spec.get(key)
        ]
        if differing:
            raise _pca_unusable_error(
                f"it was fitted on other descriptors ({'; '.join(differing)})"
            )


def decode_whitening(data: bytes) -> PcaWhiteningFile:
    """Decode the file of a whitening, which the caller verifies by its hash.

    Raises Unprocessable (`pca_unusable`) with the reason.
    """
    try:
        stored = load(data)
    except SafetensorError as error:
        raise _pca_unusable_error(
            f"it is not a safetensors file, or it is truncated ({error})"
        ) from error
    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    whitening = PcaWhitening(
        np.asarray(stored["mean"], np.float32),
        np.asarray(stored["directions"], np.float32),
        np.asarray(stored["variances"], np.float32),
        explained=float(stored["explained"].item()),
        rows=int(stored["rows"].item()),
    )
    return PcaWhiteningFile(whitening, json.loads(header["__metadata__"]["spec"]))


def _pca_unusable_error(reason: str) -> Unprocessable:
    return Unprocessable(
        "pca_unusable", f"The PCA file can't be used: {reason}. Fit a new one on the map's rows."
    )
