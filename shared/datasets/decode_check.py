"""Photos that don't decode, found by decoding them all: on all cores, each to its last pixel."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from shared.errors import Unprocessable
from shared.photo_formats import PHOTO_READ_ERRORS, check_pixel_count, open_photo

MAX_DECODED_PIXELS = 100_000_000
"""Of a photo that is decoded: more is an attack on memory, or no photo of a street."""
PHOTOS_PER_TASK = 1024


def find_undecodable(
    paths: Sequence[Path], on_progress: Callable[[int], None] = lambda count: None
) -> list[tuple[Path, str]]:
    """Each photo that can't be decoded, with what is wrong; `on_progress` is told of each photo."""
    broken = []
    # Pillow decodes without the lock. Its warnings, of strange EXIF, are ignored around all threads
    # at once: the filters are the process's, not a thread's.
    with warnings.catch_warnings(), ThreadPoolExecutor(os.cpu_count()) as pool:
        warnings.simplefilter("ignore")
        for start in range(0, len(paths), PHOTOS_PER_TASK):
            some = paths[start : start + PHOTOS_PER_TASK]
            for path, fault in zip(some, pool.map(_decode_error, some), strict=True):
                on_progress(1)
                if fault is not None:
                    broken.append((path, fault))
    return broken


def _decode_error(path: Path) -> str | None:
    try:
        with path.open("rb") as file, open_photo(file) as image:
            check_pixel_count(image.width, image.height, MAX_DECODED_PIXELS)
            image.load()
    except Unprocessable as error:
        return error.detail
    except PHOTO_READ_ERRORS as error:
        return str(error) or type(error).__name__
    return None
