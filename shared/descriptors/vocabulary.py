"""Cluster centres of VLAD vocabularies: encoding, decoding and validation.

Centres that are zero, too long, duplicate or not finite are rejected: they would spoil every
descriptor without an error.
"""

from __future__ import annotations

import hashlib
import io
import math
import struct
import tokenize
import zipfile
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared.errors import Unprocessable
from shared.extractor_config.configs import MAX_CLUSTERS
from shared.storage.chunks import read_npy_header

# Raised by NumPy for bytes that are not an array, or whose header declares an impossible one.
ARRAY_READ_ERRORS = (
    ValueError,
    TypeError,
    LookupError,
    EOFError,
    OSError,
    OverflowError,
    MemoryError,
    struct.error,
    tokenize.TokenError,
    zipfile.BadZipFile,
)

# Of a centre's norm, which is at most 1 for a mean of unit vectors; a larger one is imported. A
# photo has fewer than 1e7 patches, so that the sum of its residuals to a centre is shorter than
# 1e13, and its square, below 1e26, is far from float32's overflow at 3.4e38.
MAX_CENTRE_NORM = 1e6


@dataclass(frozen=True, slots=True, eq=False)
class ClusterCentres:
    """(clusters, dimension) float32 cluster centres and the sha256 of their bytes."""

    array: NDArray[np.float32]
    sha256: str

    @property
    def clusters(self) -> int:
        return int(self.array.shape[0])

    @property
    def dimension(self) -> int:
        return int(self.array.shape[1])


def parse_centres(array: NDArray[np.float32]) -> ClusterCentres:
    """Validate an array as cluster centres.

    Args:
        array: (clusters, dimension) of floating point numbers.

    Raises:
        Unprocessable: `vocabulary_unusable`, with the reason.
    """

    def unusable(reason: str) -> Unprocessable:
        return Unprocessable("vocabulary_unusable", f"This is not a usable vocabulary: {reason}.")

    if array.ndim != 2 or 0 in array.shape:
        raise unusable(f"its shape is {array.shape}, not (clusters, dimension)")
    if len(array) > MAX_CLUSTERS:
        raise unusable(f"it has {len(array)} centres, more than {MAX_CLUSTERS}")
    if array.dtype.kind != "f":
        raise unusable(f"its numbers are {array.dtype}, not floating point")
    with np.errstate(over="ignore"):  # overflow becomes infinite and is rejected below
        array = np.ascontiguousarray(array, dtype=np.float32)
    if not np.isfinite(array).all():
        raise unusable("it holds NaN or infinite numbers")
    norms = np.linalg.norm(array.astype(np.float64), axis=1)
    zero = np.flatnonzero(norms < 1e-6)
    if len(zero):
        raise unusable(f"centre {int(zero[0])} is zero")
    longest = int(norms.argmax())
    if norms[longest] > MAX_CENTRE_NORM:
        raise unusable(
            f"the norm of centre {longest} is {norms[longest]:.3g}, more than "
            f"{MAX_CENTRE_NORM:.0e}, with which residuals may overflow; centres of unit vectors "
            "have a norm of at most 1"
        )
    distinct = len(np.unique(array, axis=0))
    if distinct != len(array):
        raise unusable(f"only {distinct} of its {len(array)} centres are distinct")
    return ClusterCentres(array, hashlib.sha256(array.tobytes()).hexdigest())


def encode_centres(centres: ClusterCentres) -> bytes:
    """Encode the centres as a `.npy` file."""
    buffer = io.BytesIO()
    np.save(buffer, centres.array, allow_pickle=False)
    return buffer.getvalue()


def decode_centres(data: bytes) -> ClusterCentres:
    """Decode and validate the centres in the bytes of a `.npy` file.

    Raises Unprocessable (`vocabulary_unusable`).
    """
    try:
        array = decode_array(data)
    except ARRAY_READ_ERRORS as error:
        raise Unprocessable(
            "vocabulary_unusable",
            "This is not a NumPy .npy file of cluster centres, or it is truncated.",
        ) from error
    return parse_centres(array)


def decode_array(data: bytes) -> NDArray[Any]:
    """Decode the array in the bytes of a `.npy` file.

    Nothing is unpickled, and no more memory is allocated than there are bytes.

    Raises one of ARRAY_READ_ERRORS for other bytes, and Unprocessable (`vocabulary_unusable`) for
    pickled objects.
    """
    file = io.BytesIO(data)
    shape, fortran_order, dtype = read_npy_header(file)
    if dtype.hasobject:
        raise Unprocessable("vocabulary_unusable", "This file holds pickled objects, not numbers.")
    if math.prod(shape) * dtype.itemsize != len(data) - file.tell():
        raise ValueError("the header does not match the size of the data")
    values = np.frombuffer(data, dtype, offset=file.tell())
    return values.reshape(shape, order="F" if fortran_order else "C").copy()
