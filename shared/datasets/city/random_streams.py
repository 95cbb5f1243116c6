"""Independent random streams by name, so that nothing depends on the order of drawing."""

from __future__ import annotations

import zlib

import numpy as np


def random_stream(*key: int | str) -> np.random.Generator:
    """The generator that belongs to the key: the same in every process and in any order."""
    return np.random.default_rng(
        [zlib.crc32(part.encode()) if isinstance(part, str) else part for part in key]
    )
