"""The model half of a batch: its rows."""

from __future__ import annotations

import time

import numpy as np

from services.extractor.prepare import Batch
from shared.chunks import Rows
from shared.vision.passes import PhotoDoesNotFit


def describe(batch: Batch) -> Rows:
    """A row for each of the batch's `ready`, which photos that the GPU can't hold have left."""
    target = batch.target
    while batch.ready:
        started = time.perf_counter()
        try:
            if batch.stored is not None:
                assert target.projection is not None
                rows = target.projection.project(batch.stored)
            else:
                pixels = batch.pixels()
                rows = target.extractor.describe(pixels, target.centres, target.projection)
        except PhotoDoesNotFit as error:
            batch.refuse(error.place, error)
            continue
        batch.seconds["describe"] = time.perf_counter() - started
        return rows
    return np.empty((0, target.generation.dimension), np.float32)
