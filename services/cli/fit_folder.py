"""`placewise vocabulary fit DIR --out FILE.npz`: a vocabulary from a folder, without a server.

Imports torch: only `vocabulary` imports this, when asked.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rich.progress import Progress

from services.cli.configuration import read_settings
from services.cli.load_extractor import load_extractor
from services.cli.output import shown
from services.cli.photo_files import decoded_batches
from services.cli.photo_places import photo_paths
from services.cli.whole_file import whole_or_nothing
from shared.errors import InvalidRequest, PlacewiseError, Unprocessable
from shared.recipes import get_recipe
from shared.settings import Settings
from shared.vision.extractors import Extractor
from shared.vision.fit_photos import fit_photos
from shared.vision.patches import choose_photos
from shared.vision.resample import Pixels

SAMPLE_PHOTOS = 1000  # as a map's fit learns from, unless told otherwise


def fit_folder(
    folder: Path,
    out: Path,
    *,
    extractor: str | None,
    clusters: int | None,
    sample: int | None,
    seed: int | None,
    progress: Progress,
) -> dict[str, Any]:
    """Learn a vocabulary from the photos below the folder and write it to `out`.

    Returns what was written, and which photos could not be decoded. Raises InvalidRequest
    (`no_photos`, `bad_out`), Unprocessable (`no_photos`, `vocabulary_unfit`), Misconfigured
    (`out_unwritable`) and what loading the extractor raises.
    """
    _check_out(out)
    settings = read_settings()
    recipe = get_recipe(
        extractor or settings.new_map_extractor,
        allow_test_extractors=settings.allow_test_extractors,
    )
    if not recipe.needs_vocabulary:
        raise Unprocessable(
            "vocabulary_unfit",
            f"The extractor {recipe.name} uses no vocabulary: there is nothing to fit.",
        )
    there = photo_paths(folder)
    loaded = load_extractor(recipe, settings)
    seed = seed or 0
    numbers = choose_photos(len(there), sample or SAMPLE_PHOTOS, loaded.backbone.width, seed)
    photos = [there[number] for number in numbers]
    refused: list[dict[str, str]] = []
    bars = {name: progress.add_task(name, total=None) for name in ("describing", "clustering")}
    fitted = fit_photos(
        loaded,
        pixels_of(photos, loaded, settings, refused),
        len(photos),
        clusters=clusters or recipe.clusters,
        seed=seed,
        told=lambda what, done, most: progress.update(bars[what], completed=done, total=most),
    )
    with whole_or_nothing(out) as file:
        file.write(fitted.encode())
    return {
        "file": shown(out),
        "clusters": fitted.centres.clusters,
        "dimension": fitted.centres.dimension,
        "provenance": fitted.provenance,
        "refused": refused,
    }


def pixels_of(
    photos: list[Path], extractor: Extractor, settings: Settings, refused: list[dict[str, str]]
) -> Iterator[list[Pixels]]:
    """Batches of pixels in the order of the photos; those that can't be had join `refused`."""
    for batch in decoded_batches(photos, extractor.preprocessing, settings, defaultdict(float)):
        pixels = []
        for path, outcome in batch:
            if isinstance(outcome, PlacewiseError):
                refused.append({"path": shown(path), "reason": outcome.detail})
            else:
                pixels.append(outcome.pixels)
        if pixels:
            yield pixels


def _check_out(out: Path) -> None:
    """Before the minutes that a fit takes."""
    if out.suffix != ".npz":
        raise InvalidRequest("bad_out", f"{shown(out)}: a vocabulary's file ends in .npz.")
    if not out.parent.is_dir():
        raise InvalidRequest("bad_out", f"There is no folder {shown(out.parent)}.")
