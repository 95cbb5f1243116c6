"""Photos of this machine to pixels, by the decoding children of the extractor."""

from __future__ import annotations

import contextlib
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from services.cli.output import printable_path
from services.extractor.decoding import DecoderPool
from shared.errors import InvalidRequest, PlacewiseError
from shared.settings import Settings
from shared.vision.decode import DecodedPhoto
from shared.vision.preprocessing import Preprocessing
from shared.vision.resample import Pixels

DecodeOutcome = DecodedPhoto | PlacewiseError


def decode_batches(
    photos: Sequence[Path],
    preprocessing: Preprocessing,
    settings: Settings,
    seconds: defaultdict[str, float],
) -> Iterator[list[tuple[Path, DecodeOutcome]]]:
    """Batches in the order of the photos; the next one is read while this one is described.

    What that takes is added to `seconds["decode"]`. Where a photo can't be had, that says why.
    """
    decoders = DecoderPool(settings)

    def read(begin: int) -> list[tuple[Path, DecodeOutcome]]:
        begun = time.perf_counter()
        chosen = photos[begin : begin + settings.batch_photos]
        contents = [_read_photo(photo) for photo in chosen]
        outcomes = iter(
            decoders.decode(
                [content for content in contents if isinstance(content, bytes)], preprocessing
            )
        )
        found: list[tuple[Path, DecodeOutcome]] = [
            (photo, next(outcomes) if isinstance(content, bytes) else content)
            for photo, content in zip(chosen, contents, strict=True)
        ]
        seconds["decode"] += time.perf_counter() - begun
        return found

    with contextlib.closing(decoders), ThreadPoolExecutor(1) as reader:
        begins = range(0, len(photos), settings.batch_photos)
        ahead = reader.submit(read, 0)
        for begin in begins[1:]:
            batch, ahead = ahead.result(), reader.submit(read, begin)
            yield batch
        yield ahead.result()


def decode_pixels(
    photos: Sequence[Path],
    preprocessing: Preprocessing,
    settings: Settings,
    refused: list[dict[str, str]],
) -> Iterator[list[Pixels]]:
    """Batches of pixels (height, width, 3) in the order of the photos; of those that can't be had,
    path and reason join `refused`."""
    for batch in decode_batches(photos, preprocessing, settings, defaultdict(float)):
        pixels = []
        for path, outcome in batch:
            if isinstance(outcome, PlacewiseError):
                refused.append({"path": printable_path(path), "reason": outcome.detail})
            else:
                pixels.append(outcome.pixels)
        if pixels:
            yield pixels


def _read_photo(photo: Path) -> bytes | PlacewiseError:
    try:
        return photo.read_bytes()
    except OSError as error:
        return InvalidRequest("photo_unreadable", f"It can't be read: {error.strerror}.")
