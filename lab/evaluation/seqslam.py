"""SeqSLAM with constant velocity, which tracks are compared with.

Each frame is matched by the sum of the scores of the last ten frames along straight lines of
constant velocity through the map (Milford and Wyeth 2012, "SeqSLAM: Visual route-based navigation
for sunny summer days and stormy winter nights"). Scores are standardised per frame, as its local
contrast enhancement does. On a map with coordinates the lines go in twelve directions at two
speeds; on one without, forwards and backwards along the sequence.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Indices = NDArray[np.int64]

WINDOW = 10
"""frames"""
DIRECTIONS = 12
PLANE_SPEEDS = (0.7, 1.0)
"""times the typical speed"""
LINE_SPEEDS = (0.8, 0.9, 1.0, 1.1, 1.2)


def seqslam_matches(
    scores: NDArray[np.float32], positions: FloatArray, step: float, cell: float
) -> Indices:
    """Match the frames of a sequence to photos; returns their (frames,) numbers.

    Args:
        scores: (frames, n) similarities of the frames to the map's photos.
        positions: (n, 1) places along the map's sequence, or (n, 2) metres.
        step: Distance between two frames at the typical speed, in the unit of `positions`.
        cell: Photos within a cell of this side are at the same position.
    """
    standardised = _standardise(scores)
    cells, cell_of = np.unique(
        np.floor(positions / cell).astype(np.int64), axis=0, return_inverse=True
    )
    cell_of = cell_of.ravel()
    lookup = {tuple(each): number for number, each in enumerate(cells.tolist())}
    by_cell = np.full((len(scores), len(cells) + 1), 0.0)  # the last column: no photo there
    by_cell[:, :-1] = -np.inf
    np.maximum.at(by_cell.T, cell_of, standardised.T)
    paths = np.stack(
        [
            np.stack(
                [
                    _cells_at(cells, lookup, -age * velocity * step / cell)
                    for age in range(min(WINDOW, len(scores)))
                ]
            )
            for velocity in _velocities(positions.shape[1])
        ]
    )
    matches = np.zeros(len(scores), dtype=np.int64)
    for frame in range(len(scores)):
        ages = min(WINDOW, frame + 1)
        recent = by_cell[frame - np.arange(ages)]
        sums = recent[np.arange(ages)[None, :, None], paths[:, :ages]].sum(axis=1)
        best_cell = int(sums.max(axis=0).argmax())
        members = np.flatnonzero(cell_of == best_cell)
        matches[frame] = members[standardised[frame, members].argmax()]
    return matches


def _standardise(scores: NDArray[np.float32]) -> FloatArray:
    deviations = scores - scores.mean(axis=1, keepdims=True, dtype=np.float64)
    standardised: FloatArray = deviations / np.maximum(deviations.std(axis=1, keepdims=True), 1e-12)
    return standardised


def _velocities(dimensions: int) -> list[FloatArray]:
    if dimensions == 1:
        return [np.array([sign * speed]) for speed in LINE_SPEEDS for sign in (1.0, -1.0)]
    angles = np.arange(DIRECTIONS) * 2 * np.pi / DIRECTIONS
    headings = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return [np.zeros(2), *(speed * heading for speed in PLANE_SPEEDS for heading in headings)]


def _cells_at(cells: Indices, lookup: dict[tuple[int, ...], int], shift: FloatArray) -> Indices:
    """Return the number of the cell at a shift from each cell; the number of cells for none."""
    moved = (cells + np.rint(shift).astype(np.int64)).tolist()
    return np.array([lookup.get(tuple(each), len(cells)) for each in moved], dtype=np.int64)
