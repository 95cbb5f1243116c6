"""`placewise vocabulary fit DIR --out FILE.npz`: a vocabulary from a folder, without a server.

Imports torch: only `vocabulary` imports this, when asked.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.progress import Progress

from services.cli.configuration import read_settings
from services.cli.load_extractor import load_extractor
from services.cli.output import printable_path
from services.cli.photo_files import decode_pixels
from services.cli.photo_places import list_photos
from services.cli.whole_file import atomic_write, check_output_path
from shared.errors import Unprocessable
from shared.recipes import get_extractor_config
from shared.vision.fit_photos import fit_vocabulary
from shared.vision.patches import sample_photos

DEFAULT_SAMPLE_PHOTOS = 1000  # as a map's fit learns from, unless told otherwise


def fit_vocabulary_on_folder(
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
    check_output_path(out, ".npz", "a vocabulary")
    settings = read_settings()
    recipe = get_extractor_config(
        extractor or settings.new_map_extractor,
        allow_test_extractors=settings.allow_test_extractors,
    )
    if not recipe.needs_vocabulary:
        raise Unprocessable(
            "vocabulary_unfit",
            f"The extractor {recipe.name} uses no vocabulary: there is nothing to fit.",
        )
    there = list_photos(folder)
    loaded = load_extractor(recipe, settings)
    seed = seed or 0
    numbers = sample_photos(
        len(there), sample or DEFAULT_SAMPLE_PHOTOS, loaded.backbone.width, seed
    )
    photos = [there[number] for number in numbers]
    refused: list[dict[str, str]] = []
    bars = {name: progress.add_task(name, total=None) for name in ("describing", "clustering")}
    fitted = fit_vocabulary(
        loaded,
        decode_pixels(photos, loaded.preprocessing, settings, refused),
        len(photos),
        clusters=clusters or recipe.clusters,
        seed=seed,
        on_progress=lambda what, done, most: progress.update(
            bars[what], completed=done, total=most
        ),
    )
    with atomic_write(out) as file:
        file.write(fitted.encode())
    return {
        "file": printable_path(out),
        "clusters": fitted.centres.clusters,
        "dimension": fitted.centres.dimension,
        "provenance": fitted.provenance,
        "refused": refused,
    }
