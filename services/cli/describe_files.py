"""Photos to rows of a .npy file by the path of every upload: decoding children, then one batch
after the other. Imports torch.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from services.cli.output import shown
from services.extractor.decoding import DecoderPool
from shared.errors import InvalidRequest, Misconfigured, PlacewiseError, Unprocessable
from shared.recipes import Recipe
from shared.settings import Settings
from shared.vision.decode import Decoded
from shared.vision.extractors import Extractor, choose_device, not_finite
from shared.vision.vocabulary import Centres, check_centres, read_centres

Outcome = Decoded | PlacewiseError


@dataclass(slots=True)
class DescribedFiles:
    """What was written, and how."""

    out: Path
    spec: dict[str, Any]
    rows: int
    seconds: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))
    """By stage. Photos are decoded while the batch before is described: the sum may be more than
    `total`.
    """

    def as_json(self) -> dict[str, Any]:
        return {
            "file": shown(self.out),
            "rows": self.rows,
            "dimension": self.spec["dimension"],
            "spec": self.spec,
            "seconds": {stage: round(took, 3) for stage, took in self.seconds.items()},
        }


def describe_files(
    photos: Sequence[Path],
    out: Path,
    recipe: Recipe,
    vocabulary: Path | None,
    settings: Settings,
    advance: Callable[[int], None],
) -> DescribedFiles:
    """Write (photos, dimension) float32 to `out`, whole or not at all.

    `advance` is told how many more photos are done. Raises Unprocessable: `photos_refused`, which
    names every photo that can't be described and why; `vocabulary_unfit`; Misconfigured:
    `vocabulary_missing`, `out_unwritable`, and what loading the extractor raises.
    """
    started = time.perf_counter()
    centres = _own_centres(recipe, vocabulary)
    extractor = Extractor(
        recipe, choose_device(settings.device), dino_weights=settings.dino_weights
    )
    if recipe.needs_vocabulary and centres is None:
        shipped = extractor.shipped_vocabulary()
        assert shipped is not None, "asked of the recipe before"
        centres = shipped[0]
    described = DescribedFiles(out, extractor.spec(centres), len(photos))
    described.seconds["load"] = time.perf_counter() - started
    shape = (len(photos), extractor.dimension(centres))
    refused: list[tuple[Path, PlacewiseError]] = []
    with _whole_or_nothing(out) as file:
        np.lib.format.write_array_header_1_0(
            file, {"descr": "<f4", "fortran_order": False, "shape": shape}
        )
        for batch in _decoded(photos, extractor, settings, described.seconds):
            pixels = []
            for photo, outcome in batch:
                if isinstance(outcome, PlacewiseError):
                    refused.append((photo, outcome))
                else:
                    pixels.append(outcome.pixels)
            if not refused:  # after a refusal, the rest is read for what else can't be described
                begun = time.perf_counter()
                rows = extractor.describe(pixels, centres)
                described.seconds["describe"] += time.perf_counter() - begun
                for (photo, _), row in zip(batch, rows, strict=True):
                    if not np.isfinite(row).all():
                        refused.append((photo, not_finite()))
                file.write(np.ascontiguousarray(rows, "<f4").tobytes())
            advance(len(batch))
        if refused:
            raise _refusal(refused, len(photos))
    described.seconds["total"] = time.perf_counter() - started
    return described


def _own_centres(recipe: Recipe, vocabulary: Path | None) -> Centres | None:
    """Those of the file; None where the recipe does without, or brings its own."""
    if vocabulary is not None:
        if not recipe.needs_vocabulary:
            raise Unprocessable(
                "vocabulary_unfit", f"The extractor {recipe.name} uses no vocabulary."
            )
        return check_centres(read_centres(vocabulary).array, width=recipe.width)
    if recipe.needs_vocabulary and recipe.shipped_vocabulary is None:
        raise Misconfigured(
            "vocabulary_missing",
            f"The extractor {recipe.name} needs a vocabulary, and none comes with it: "
            "--vocabulary FILE, or --aggregator gem, which does without.",
        )
    return None


def _decoded(
    photos: Sequence[Path],
    extractor: Extractor,
    settings: Settings,
    seconds: defaultdict[str, float],
) -> Iterator[list[tuple[Path, Outcome]]]:
    """Batches in the order of the photos; the next one is read while this one is described."""
    decoders = DecoderPool(settings)

    def read(begin: int) -> list[tuple[Path, Outcome]]:
        begun = time.perf_counter()
        chosen = photos[begin : begin + settings.batch_photos]
        contents = [_content(photo) for photo in chosen]
        outcomes = iter(
            decoders.decode(
                [content for content in contents if isinstance(content, bytes)],
                extractor.preprocessing,
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


def _content(photo: Path) -> bytes | PlacewiseError:
    try:
        return photo.read_bytes()
    except OSError as error:
        return InvalidRequest("photo_unreadable", f"It can't be read: {error.strerror}.")


@contextlib.contextmanager
def _whole_or_nothing(out: Path) -> Iterator[BinaryIO]:
    """A file that takes its name when the block has ended well; else nothing is left of it."""
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


def _refusal(refused: list[tuple[Path, PlacewiseError]], photos: int) -> Unprocessable:
    named = "\n".join(f"{shown(photo)}: {error.detail}" for photo, error in refused)
    return Unprocessable(
        "photos_refused",
        f"{len(refused)} of {photos} photos can't be described, and nothing was written.\n{named}",
        refused=[
            {"photo": shown(photo), "code": error.code, "detail": error.detail}
            for photo, error in refused
        ],
    )
