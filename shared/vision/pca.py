"""PCA whitening: descriptors made short, and equally strong in all their directions.

As in Jegou and Chum (Negative evidences and co-occurrences in image retrieval, ECCV 2012), and as
AnyLoc's PCA rows (RA-L 2023: whitened, then L2-normalised again). Of n database rows x_i with mean
m, centred to X (n x D), and of the d largest variances l_1 >= ... >= l_d of their covariance
X'X / (n - 1) with the unit directions p_j:

    y_j = <p_j, x - m> / sqrt(l_j)          row = y / |y|

It is fitted on database rows only: queries would tell the map what they are.

At 98,304 dimensions the covariance (39 GB) can't be held. With fewer rows than dimensions the same
directions come from the n x n Gram matrix (Turk and Pentland 1991): XX' = U diag(s^2) U' gives
l = s^2 / (n - 1) and p = X'u / s. X is read in blocks of columns, each centred by its own mean,
once for XX' and once for the directions, so that memory holds n x n numbers, one block, and the
d x D result. What the n rows are is up to who fits: `gather` takes a fair sample of a stream.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn.functional import normalize

from shared.errors import Unprocessable

BLOCK_BYTES = 64_000_000  # of float64 columns that are looked at together
# Of the largest one: below, float32's rounding of the rows is what would be made strong.
LEAST_VARIANCE = 1e-9

Rows = NDArray[np.float32]
Matrix = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Whitening:
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


def whiten(rows: torch.Tensor, mean: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
    """(B, D) unit rows, (D,), (d, D) of a Whitening -> (B, d) unit rows; all on one device.

    A row that equals the mean has no direction and becomes zero.
    """
    return normalize((rows - mean) @ directions.T, dim=-1)


def gather(blocks: Iterable[Rows], dimension: int, folder: Path, *, rows: int, seed: int) -> Rows:
    """A fair sample of at most `rows` rows of a stream of (b, D) blocks, mapped from a file.

    Each row of the stream is in it with the same probability (Vitter 1985, algorithm R); the same
    stream and seed give the same sample. Memory holds one block.
    """
    file = folder / "sample.f32"
    sample = np.memmap(file, dtype=np.float32, mode="w+", shape=(rows, dimension))
    rng = np.random.default_rng(seed)
    seen = 0
    for block in blocks:
        for row in block:
            place = seen if seen < rows else int(rng.integers(seen + 1))
            if place < rows:
                sample[place] = row
            seen += 1
    return sample[: min(seen, rows)]


def fit(rows: Rows, kept: int, *, block_bytes: int = BLOCK_BYTES) -> Whitening:
    """The whitening of (n, D) rows, which may be mapped from a file, to `kept` dimensions.

    Unprocessable: `pca_too_few_rows` unless n > kept; `pca_too_many_dimensions` when the rows vary
    in fewer directions than `kept`, or have fewer dimensions.
    """
    count, dimension = rows.shape
    if kept > dimension:
        raise Unprocessable(
            "pca_too_many_dimensions",
            f"Descriptors of {dimension} dimensions can't be brought to {kept}. Take fewer.",
        )
    if count <= kept:
        raise Unprocessable(
            "pca_too_few_rows",
            f"PCA to {kept} dimensions needs more than {kept} described photos, better several "
            f"times as many, and there are {count}. Index more photos, or take fewer dimensions.",
        )
    if count <= dimension:
        mean, variances, directions, total = _by_gram(rows, kept, block_bytes)
    else:
        mean, variances, directions, total = _by_covariance(rows, kept, block_bytes)
    _fix_signs(directions)
    return Whitening(
        mean=mean.astype(np.float32),
        directions=directions,
        variances=variances.astype(np.float32),
        explained=float(variances.sum() / total),
        rows=count,
    )


def _by_gram(rows: Rows, kept: int, block_bytes: int) -> tuple[Matrix, Matrix, Rows, float]:
    """Mean, variances, scaled directions and the whole variance, from the n x n Gram matrix."""
    count, dimension = rows.shape
    gram = np.zeros((count, count))
    mean = np.empty(dimension)
    for columns in _slices(dimension, 8 * count, block_bytes):
        block, mean[columns] = _centred(rows[:, columns])
        gram += block @ block.T
    squares, basis = _largest(gram, kept)
    # p / sqrt(l) = X'u / s * sqrt(n - 1) / s
    scaled = basis * (np.sqrt(count - 1) / squares)
    directions = np.empty((kept, dimension), dtype=np.float32)
    for columns in _slices(dimension, 8 * count, block_bytes):
        block, _ = _centred(rows[:, columns])
        directions[:, columns] = scaled.T @ block
    return mean, squares / (count - 1), directions, float(np.trace(gram)) / (count - 1)


def _by_covariance(rows: Rows, kept: int, block_bytes: int) -> tuple[Matrix, Matrix, Rows, float]:
    """The same from the D x D covariance, which is the smaller matrix of many short rows."""
    count, dimension = rows.shape
    slices = list(_slices(count, 8 * dimension, block_bytes))
    mean = np.zeros(dimension)
    for part in slices:
        mean += rows[part].sum(axis=0, dtype=np.float64)
    mean /= count
    covariance = np.zeros((dimension, dimension))
    for part in slices:
        centred = rows[part] - mean
        covariance += centred.T @ centred
    covariance /= count - 1
    variances, basis = _largest(covariance, kept)
    directions = (basis / np.sqrt(variances)).T.astype(np.float32)
    return mean, variances, directions, float(np.trace(covariance))


def _largest(matrix: Matrix, kept: int) -> tuple[Matrix, Matrix]:
    """The `kept` largest eigenvalues, largest first, and their (N, kept) unit eigenvectors."""
    values, vectors = np.linalg.eigh(matrix)
    values, vectors = values[::-1][:kept], vectors[:, ::-1][:, :kept]
    usable = int((values > LEAST_VARIANCE * max(values[0], 0)).sum())
    if usable < kept:
        raise Unprocessable(
            "pca_too_many_dimensions",
            f"The described photos vary in {usable} directions only, and PCA to {kept} dimensions "
            "needs as many. Index more different photos, or take fewer dimensions.",
        )
    return values, vectors


def _centred(block: Rows) -> tuple[Matrix, Matrix]:
    """The columns without their means, in float64, and the means."""
    wide = block.astype(np.float64)
    means: Matrix = wide.mean(axis=0)
    wide -= means
    return wide, means


def _slices(length: int, bytes_each: int, block_bytes: int) -> Iterator[slice]:
    step = max(1, block_bytes // bytes_each)
    for begin in range(0, length, step):
        yield slice(begin, begin + step)


def _fix_signs(directions: Rows) -> None:
    """Of two opposite directions the one whose strongest number is positive: the same everywhere,
    whichever way the eigenvectors came."""
    for direction in directions:
        if direction[np.abs(direction).argmax()] < 0:
            np.negative(direction, out=direction)
