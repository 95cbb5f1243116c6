"""PCA whitening: descriptors made short, and equally strong in all their directions.

As in Jegou and Chum (Negative evidences and co-occurrences in image retrieval, ECCV 2012), and as
AnyLoc's PCA rows (RA-L 2023: whitened, then L2-normalised again). Of n database rows x_i with mean
m, centred to X (n x D), and of the d largest variances l_1 >= ... >= l_d of their covariance
X'X / (n - 1) with the unit directions p_j:

    y_j = <p_j, x - m> / sqrt(l_j)          row = y / |y|

`shared.vision.pca_fit` finds mean and directions.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn.functional import normalize

Rows = NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class PcaWhitening:
    """A fitted projection."""

    mean: NDArray[np.float32]
    """(D,)"""
    directions: NDArray[np.float32]
    """(d, D): each unit direction divided by its standard deviation."""
    variances: NDArray[np.float32]
    """(d,) of the rows along the directions, largest first."""
    explained: float
    """The share of the rows' whole variance that lies along them, 0 to 1."""
    rows: int
    """How many it was fitted on."""

    @property
    def dimension(self) -> int:
        """Length of a descriptor before."""
        return int(self.directions.shape[1])

    @property
    def kept(self) -> int:
        """Length of a descriptor after."""
        return int(self.directions.shape[0])

    @property
    def sha256(self) -> str:
        """Of what decides a projected descriptor's value."""
        digest = hashlib.sha256(np.ascontiguousarray(self.mean).data)
        digest.update(np.ascontiguousarray(self.directions).data)
        return digest.hexdigest()


class PcaProjection:
    """A whitening on a device, at work."""

    def __init__(self, whitening: PcaWhitening, device: torch.device) -> None:
        self.dimension = whitening.dimension
        """Length of a descriptor before."""
        self.kept = whitening.kept
        """Length of a descriptor after."""
        self.sha256 = whitening.sha256
        self._mean = _tensor(whitening.mean).to(device)
        self._directions = _tensor(whitening.directions).to(device)

    @torch.inference_mode()
    def __call__(self, rows: torch.Tensor) -> torch.Tensor:
        """(B, dimension) float32 rows on the device -> (B, kept) unit rows.

        A row of zeros, a photo in which there is nothing to describe, stays zero: as it was like no
        other photo, it is not to be like those that share its distance to the mean. The mean
        itself has no direction and becomes zero, too.
        """
        whitened = normalize((rows - self._mean) @ self._directions.T, dim=-1)
        return torch.where(rows.any(dim=-1, keepdim=True), whitened, 0)

    def project(self, rows: Rows) -> Rows:
        """The same of stored rows."""
        projected: Rows = self(_tensor(rows).to(self._mean.device)).cpu().numpy()
        return projected


def _tensor(array: Rows) -> torch.Tensor:
    # What lies in a file's bytes is read-only, and torch wants none of that.
    return torch.from_numpy(np.require(array, requirements=["C", "W"]))
