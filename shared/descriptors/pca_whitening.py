"""PCA whitening: descriptors made short, and equally strong in all their directions.

As in Jegou and Chum (Negative evidences and co-occurrences in image retrieval, ECCV 2012), and as
AnyLoc's PCA rows (RA-L 2023: whitened, then L2-normalised again). Of n database rows x_i with mean
m, centred to X (n x D), and of the d largest variances l_1 >= ... >= l_d of their covariance
X'X / (n - 1) with the unit directions p_j:

    y_j = <p_j, x - m> / sqrt(l_j)          row = y / |y|

`shared.descriptors.pca_fit` finds mean and directions.

Files of PCA whitenings: safetensors, checked before they spoil a descriptor.

The header's `__metadata__` may hold `spec`, a string of JSON: how the rows were described that it
was fitted on (`Extractor.spec`).
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn.functional import normalize

from shared.errors import Unprocessable

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


TENSOR_NAMES = ("mean", "directions", "variances", "explained", "rows")

# What changes a descriptor by its last bits alone: a whitening outlives it.
IGNORED_SPEC_FIELDS = ("decoder", "precision")


@dataclass(frozen=True, slots=True, eq=False)
class PcaWhiteningFile:
    whitening: PcaWhitening
    spec: dict[str, Any] | None
    """Of the rows that it was fitted on; None where that is unknown."""

    def encode(self) -> bytes:
        """The bytes of a `.safetensors` file."""
        from safetensors.numpy import save

        found = self.whitening
        return save(
            {
                "mean": np.ascontiguousarray(found.mean),
                "directions": np.ascontiguousarray(found.directions),
                "variances": np.ascontiguousarray(found.variances),
                "explained": np.array([found.explained], dtype=np.float64),
                "rows": np.array([found.rows], dtype=np.int64),
            },
            None if self.spec is None else {"spec": json.dumps(self.spec, sort_keys=True)},
        )

    def check_compatible(self, spec: dict[str, Any]) -> None:
        """Unprocessable (`pca_unfit`) naming what differs unless descriptors of `spec`, which are
        not projected yet, are like the rows that it was fitted on. Of unknown rows only the
        dimension can be compared.
        """
        if self.whitening.dimension != spec["dimension"]:
            raise _pca_unfit_error(
                f"it is for descriptors of {self.whitening.dimension} dimensions, and these have "
                f"{spec['dimension']}"
            )
        if self.spec is None:
            return
        differing = [
            f"{key} is {spec.get(key)!r}, was {self.spec.get(key)!r}"
            for key in sorted(spec.keys() | self.spec.keys())
            if key not in IGNORED_SPEC_FIELDS and spec.get(key) != self.spec.get(key)
        ]
        if differing:
            raise _pca_unfit_error(f"it was fitted on other descriptors ({'; '.join(differing)})")


def decode_whitening(data: bytes) -> PcaWhiteningFile:
    """The whitening in such bytes; Unprocessable (`pca_unfit`) says what is wrong with it."""
    from safetensors import SafetensorError
    from safetensors.numpy import load

    try:
        stored = load(data)
    except SafetensorError as error:
        raise _pca_unfit_error(
            f"it is no safetensors file, or not a whole one ({error})"
        ) from error
    return PcaWhiteningFile(_whitening(stored), _spec(data))


def _spec(data: bytes) -> dict[str, Any] | None:
    """That of the header, which is known to be whole; None where there is none."""
    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    text = header.get("__metadata__", {}).get("spec")
    if text is None:
        return None
    try:
        spec = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise _pca_unfit_error(f"the spec in it can't be read ({error})") from error
    if not isinstance(spec, dict):
        raise _pca_unfit_error("the spec in it is none")
    return spec


def _whitening(stored: dict[str, NDArray[np.generic]]) -> PcaWhitening:
    missing = [name for name in TENSOR_NAMES if name not in stored]
    if missing:
        raise _pca_unfit_error(f"it has no {', '.join(missing)}")
    mean, directions, variances = (_floats(stored, name) for name in TENSOR_NAMES[:3])
    shapes = (mean.shape, variances.shape)
    if directions.ndim != 2 or shapes != (directions.shape[1:], directions.shape[:1]):
        raise _pca_unfit_error(
            f"its mean {mean.shape}, directions {directions.shape} and variances "
            f"{variances.shape} do not belong together: (D,), (d, D) and (d,) are expected"
        )
    kept, made_for = directions.shape
    if not 0 < kept <= made_for:
        raise _pca_unfit_error(f"it makes {kept} dimensions of {made_for}")
    if not (variances > 0).all():
        raise _pca_unfit_error("a variance is not positive")
    # A unit direction divided by its standard deviation, as far as float32 goes.
    lengths = np.linalg.norm(directions, axis=1) * np.sqrt(variances)
    if not np.allclose(lengths, 1.0, rtol=0.01):
        raise _pca_unfit_error("its directions are not those of its variances")
    try:
        return PcaWhitening(
            mean,
            directions,
            variances,
            explained=float(stored["explained"].item()),
            rows=int(stored["rows"].item()),
        )
    except ValueError as error:
        raise _pca_unfit_error(f"explained and rows are one number each ({error})") from error


def _floats(stored: dict[str, NDArray[np.generic]], name: str) -> NDArray[np.float32]:
    array = stored[name]
    if array.dtype != np.float32:
        raise _pca_unfit_error(f"its {name} is {array.dtype}, not float32")
    floats = array.astype(np.float32, copy=False)
    if not np.isfinite(floats).all():
        raise _pca_unfit_error(f"its {name} holds NaN or infinite numbers")
    return floats


def _pca_unfit_error(reason: str) -> Unprocessable:
    return Unprocessable(
        "pca_unfit", f"The PCA file can't be used: {reason}. Fit a new one on the map's rows."
    )
