"""Photos that don't decode, found by decoding them all: on all cores, each to its last pixel."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from shared.errors import Unprocessable
from shared.photo_formats import BROKEN, check_pixels, open_photo

MOST_PIXELS = 100_000_000
"""Of a photo that is decoded: more is an attack on memory, or no photo of a street."""
AT_ONCE = 1024


def undecodable(
    paths: Sequence[Path], done: Callable[[int], None] = lambda count: None
) -> list[tuple[Path, str]]:
    """Each photo that can't be decoded, with what is wrong; `done` is told of each photo."""
    broken = []
    # Pillow decodes without the lock. Its warnings, of strange EXIF, are ignored around all threads
    # at once: the filters are the process's, not a thread's.
    with warnings.catch_warnings(), ThreadPoolExecutor(os.cpu_count()) as pool:
        warnings.simplefilter("ignore")
        for start in range(0, len(paths), AT_ONCE):
            some = paths[start : start + AT_ONCE]
            for path, fault in zip(some, pool.map(_fault_of, some), strict=True):
                done(1)
                if fault is not None:
                    broken.append((path, fault))
    return broken


def _fault_of(path: Path) -> str | None:
    try:
        with path.open("rb") as file, open_photo(file) as image:
            check_pixels(image.width, image.height, MOST_PIXELS)
            image.load()
    except Unprocessable as error:
        return error.detail
    except BROKEN as error:
        return str(error) or type(error).__name__
    return None
