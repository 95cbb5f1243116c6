"""Photos of this machine to pixels, and what is learnt of them to a file. Imports torch."""

from __future__ import annotations

import contextlib
import os
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import BinaryIO

from services.cli.output import shown
from services.extractor.decoding import DecoderPool
from shared.errors import InvalidRequest, Misconfigured, PlacewiseError
from shared.settings import Settings
from shared.vision.decode import Decoded
from shared.vision.preprocessing import Preprocessing

Outcome = Decoded | PlacewiseError


def decoded_batches(
    photos: Sequence[Path],
    preprocessing: Preprocessing,
    settings: Settings,
    seconds: defaultdict[str, float],
) -> Iterator[list[tuple[Path, Outcome]]]:
    """Batches in the order of the photos; the next one is read while this one is described.

    What that takes is added to `seconds["decode"]`. Where a photo can't be had, that says why.
    """
    decoders = DecoderPool(settings)

    def read(begin: int) -> list[tuple[Path, Outcome]]:
        begun = time.perf_counter()
        chosen = photos[begin : begin + settings.batch_photos]
        contents = [_content(photo) for photo in chosen]
        outcomes = iter(
            decoders.decode(
                [content for content in contents if isinstance(content, bytes)], preprocessing
            )
        )
        found: list[tuple[Path, Outcome]] = [
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


@contextlib.contextmanager
def whole_or_nothing(out: Path) -> Iterator[BinaryIO]:
    """A file that takes its name when the block has ended well; else nothing is left of it.

    Raises Misconfigured (`out_unwritable`).
    """
    partial = out.with_name(f".{out.name}.{os.getpid()}.partial")
    try:
        with partial.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        partial.replace(out)
    except OSError as error:
        raise Misconfigured(
            "out_unwritable", f"{shown(out)} can't be written: {error.strerror}."
        ) from error
    finally:
        # Where even the folder is missing, there is nothing to take away.
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)


def _content(photo: Path) -> bytes | PlacewiseError:
    try:
        return photo.read_bytes()
    except OSError as error:
        return InvalidRequest("photo_unreadable", f"It can't be read: {error.strerror}.")
