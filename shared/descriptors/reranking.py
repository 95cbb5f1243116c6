"""Reranking by local features: spatially consistent mutual nearest neighbours.

Local features are stored as

    <generation>/<photo>.npy     (rows, columns, D) float16, little-endian, C order

Two bytes a number: 44 kB with EfficientNet-Lite0 at 224 px (196 patches of 112), 786 kB with
DINOv2's ViT-g there (256 of 1,536), 4.7 MB at 480 x 640. Rounding changes a cosine by less than
0.001. Features are always rounded before they are compared, so that a score does not depend on
whether they were stored.

The score:

1. Mutual nearest neighbours: patch i of the query and patch j of the candidate match when each is
   the other's most similar one; s_m = <x_i, y_j>, and only s_m > 0 counts.
2. A vote on the shift between the views. Positions are measured from the photo's middle in units of
   the photo's sides, so that grids of different sizes can be compared: match m leads from p_m to
   p'_m. At a scale z its shift is d_m = p'_m - z p_m, and the shift with the most support counts:

       V = max over z in SCALES and n of  sum over m of s_m exp(-|d_m - d_n|^2 / (2 SIGMA^2))

   Random matches have random shifts. Matches of the same place, seen from another distance or
   position, have similar ones.
3. vote = V / min(patches of the query, patches of the candidate), from 0 to 1.

    rerank score = similarity + WEIGHT * vote

Mutual neighbours with a spatial check are the usual way to rerank (Hausler et al., CVPR 2021,
"Patch-NetVLAD", section 3.4, checks displacements, too). Unlike there, the vote is smooth over
several scales and is added to the similarity; `lab/benchmarks/RESULTS.md` has measurements.
"""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from shared.descriptors.vocabulary import ARRAY_READ_ERRORS, decode_array
from shared.errors import Unprocessable

FLOAT16 = np.dtype("<f2")


@dataclass(frozen=True, slots=True, eq=False)
class LocalFeatures:
    """Local features of one photo.

    (rows, columns, D) float16; each patch has length 1 (or 0), up to rounding.
    """

    array: NDArray[np.float16]

    @classmethod
    def from_features(cls, features: torch.Tensor, grid: tuple[int, int]) -> LocalFeatures:
        """Convert (patches, D) float32 CPU features, row by row of `grid` (rows, columns)."""
        return cls(features.numpy().astype(FLOAT16).reshape(*grid, -1))

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.array.shape[0], self.array.shape[1]

    @property
    def finite(self) -> bool:
        """Whether all numbers are finite."""
        return bool(np.isfinite(self.array).all())

    def patches(self, device: torch.device) -> torch.Tensor:
        """Return the (patches, D) float32 features on a device."""
        flat = self.array.reshape(-1, self.array.shape[2]).astype(np.float32)
        return torch.from_numpy(flat).to(device)

    def encode(self) -> bytes:
        """Encode as a `.npy` file."""
        buffer = io.BytesIO()
        np.save(buffer, self.array, allow_pickle=False)
        return buffer.getvalue()

    @classmethod
    def decode(cls, data: bytes, width: int) -> LocalFeatures:
        """Decode the result of `encode`; ValueError if it is malformed or D is not `width`."""
        try:
            array = decode_array(data)
        except (*ARRAY_READ_ERRORS, Unprocessable) as error:
            raise ValueError(f"not a NumPy array: {error}") from error
        if array.dtype != FLOAT16 or array.ndim != 3 or array.shape[2] != width or not array.size:
            raise ValueError(
                f"{array.dtype} of {array.shape}, not float16 (rows, columns, {width})"
            )
        return cls(array)


SCALES = (0.5, 0.71, 1.0, 1.41, 2.0)
SHIFT_SIGMA = 0.085  # sides of the photo: 1.2 patches of a 14 x 14 grid
# Tuned on a synthetic city that no published result uses: values from 0.2 to 1 improve recall; the
# vote alone, without the similarity, lowers it.
VOTE_WEIGHT = 0.5

BLOCK_ROWS = 2048  # query patches per block: all similarities of two large photos are gigabytes
MAX_SHIFTS = 512  # shifts tried: those of the most similar matches

Matches = tuple[torch.Tensor, torch.Tensor, torch.Tensor]


def rerank_score(
    similarity: float, query: LocalFeatures, candidate: LocalFeatures, device: torch.device
) -> float:
    """Return the rerank score: the similarity of the descriptors plus the weighted vote."""
    return similarity + VOTE_WEIGHT * spatial_vote(query, candidate, device)


@torch.inference_mode()
def spatial_vote(query: LocalFeatures, candidate: LocalFeatures, device: torch.device) -> float:
    """Return the share of patches that match with a consistent shift, 0 to 1."""
    x, y = query.patches(device), candidate.patches(device)
    of_query, of_candidate, similarities = mutual_matches(x, y)
    if not len(similarities):
        return 0.0
    begin = _patch_centres(query.grid, device)[of_query]
    end = _patch_centres(candidate.grid, device)[of_candidate]
    strongest = similarities.argsort(descending=True, stable=True)[:MAX_SHIFTS]
    best = 0.0
    for scale in SCALES:
        shifts = end - scale * begin
        squared_distances = (shifts[strongest, None] - shifts[None]).square().sum(dim=-1)
        votes = torch.exp(-squared_distances / (2 * SHIFT_SIGMA**2)) @ similarities
        best = max(best, float(votes.max()))
    return best / min(len(x), len(y))


@torch.inference_mode()
def mutual_matches(x: torch.Tensor, y: torch.Tensor) -> Matches:
    """Find mutual nearest neighbours of (P, D) and (Q, D) unit rows.

    The first of equally similar rows wins. Rows with no positive similarity, such as zero patches,
    match nothing.

    Returns:
        (M,) rows of x, (M,) rows of y, (M,) similarities.
    """
    nearest_of_x = torch.empty(len(x), dtype=torch.int64, device=x.device)
    similarities = torch.empty(len(x), device=x.device)
    nearest_of_y = torch.zeros(len(y), dtype=torch.int64, device=x.device)
    best_of_y = torch.full((len(y),), -torch.inf, device=x.device)
    for begin in range(0, len(x), BLOCK_ROWS):
        rows = slice(begin, begin + BLOCK_ROWS)
        block = x[rows] @ y.T
        similarities[rows], nearest_of_x[rows] = block.max(dim=1)
        best, row = block.max(dim=0)
        better = best > best_of_y
        best_of_y[better] = best[better]
        nearest_of_y[better] = begin + row[better]
    all_rows = torch.arange(len(x), device=x.device)
    mutual = (nearest_of_y[nearest_of_x] == all_rows) & (similarities > 0)
    return all_rows[mutual], nearest_of_x[mutual], similarities[mutual]


def _patch_centres(grid: tuple[int, int], device: torch.device) -> torch.Tensor:
    """Return (rows * columns, 2) patch centres from the photo's middle, in units of its sides."""
    rows, columns = ((torch.arange(count, device=device) + 0.5) / count - 0.5 for count in grid)
    return torch.cartesian_prod(rows, columns)
