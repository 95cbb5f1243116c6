"""The model half of a batch: its rows."""

from __future__ import annotations

import time

import numpy as np

from services.extractor.prepare import DescribeBatch
from shared.chunks import Rows
from shared.vision.passes import PhotoTooLargeForGpu


def describe_batch(batch: DescribeBatch) -> Rows:
    """A row for each of the batch's `ready`, which photos that the GPU can't hold have left."""
    target = batch.target
    while batch.ready:
        started = time.perf_counter()
        try:
            if batch.stored_rows is not None:
                assert target.projection is not None
                rows = target.projection.project(batch.stored_rows)
            else:
                pixels = batch.pixels()
                rows = target.extractor.describe(pixels, target.centres, target.projection)
        except PhotoTooLargeForGpu as error:
            batch.reject(error.place, error)
            continue
        batch.seconds["describe"] = time.perf_counter() - started
        return rows
    return np.empty((0, target.generation.dimension), np.float32)
