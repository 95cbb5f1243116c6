"""Rows of a data set shortened by PCA whitening, learnt from its database rows alone."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch

from services.trainer.evaluation.describe import Rows
from shared.vision.pca import PcaProjection, PcaWhitening
from shared.vision.pca_fit import check_pca_fittable
from shared.vision.pca_rows import sample_rows, sample_size
from shared.vision.pca_stream import fit_pca_stream

BLOCK_BYTES = 64_000_000
SEED = 0


@dataclass(frozen=True, slots=True)
class WhitenedSet:
    database: Rows
    queries: Rows
    whitening: PcaWhitening
    milliseconds_a_photo: float
    """what shortening one row takes"""


def whiten_set(
    database: Rows,
    queries: Rows,
    components: int,
    device: torch.device,
    on_progress: Callable[[str, int, int], None] = lambda what, done, most: None,
) -> WhitenedSet:
    """(m, D) and (n, D) rows -> (m, kept) and (n, kept).

    Raises Unprocessable (`pca_too_few_rows`, `pca_too_many_dimensions`).
    """
    dimension = database.shape[1]
    check_pca_fittable(len(database), dimension, components)
    chosen = sample_rows(len(database), sample_size(dimension, components), SEED)
    at_once = max(1, BLOCK_BYTES // (4 * dimension))
    batches = (database[chosen[b : b + at_once]] for b in range(0, len(chosen), at_once))
    whitening = fit_pca_stream(batches, len(chosen), dimension, components, on_progress)
    projection = PcaProjection(whitening, device)
    begun = time.perf_counter()
    short = [_project(rows, projection, at_once, device) for rows in (database, queries)]
    took = time.perf_counter() - begun
    return WhitenedSet(
        short[0], short[1], whitening, 1000 * took / max(1, len(database) + len(queries))
    )


def _project(rows: Rows, projection: PcaProjection, at_once: int, device: torch.device) -> Rows:
    short = np.empty((len(rows), projection.kept), np.float32)
    for begin, block in _blocks(rows, at_once):
        projected = projection(torch.from_numpy(block).to(device)).cpu().numpy()
        short[begin : begin + len(block)] = projected
    return short


def _blocks(rows: Rows, at_once: int) -> Iterator[tuple[int, Rows]]:
    for begin in range(0, len(rows), at_once):
        yield begin, np.array(rows[begin : begin + at_once])
