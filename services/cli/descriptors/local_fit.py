"""`placewise vocabulary fit DIR --out FILE.npz`: a vocabulary from a folder, without a server.

Imports torch: only `vocabulary` imports this, when asked.

`placewise pca fit ROWS.npy|DIR --out FILE.safetensors`: a whitening without a server.

Imports torch: only `pca` imports this, when asked.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import Progress

from services.cli.descriptors.local_extractor import (
    decode_pixels,
    load_extractor,
    load_own_vocabulary,
    resolve_centres,
)
from services.cli.environment import read_settings
from services.cli.ingest.geotags import list_photos
from services.cli.output import atomic_write, check_output_path, printable_path
from shared.config.settings import Settings
from shared.descriptors.extractor import Extractor
from shared.descriptors.patches import fit_vocabulary, sample_photos
from shared.descriptors.pca_fit import check_pca_fittable, fit_pca_stream, sample_rows, sample_size
from shared.descriptors.pca_whitening import PcaWhiteningFile, Rows
from shared.descriptors.vocabulary import ClusterCentres
from shared.errors import InvalidRequest, Unprocessable
from shared.extractor_config.configs import get_extractor_config

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


READ_BLOCK_BYTES = 16_000_000  # of rows that are read together
UNIT_NORM_TOLERANCE = 0.01  # of a row's length: half precision keeps three digits
SEED = 0  # which rows are learnt from, where there are more than needed


def fit_pca_locally(
    source: Path,
    out: Path,
    components: int,
    *,
    extractor: str | None,
    vocabulary: Path | None,
    progress: Progress,
) -> dict[str, Any]:
    """Fit on the rows of a `.npy` file, or on the photos below a folder, and write it to `out`.

    Returns what was written, and which photos could not be described. Raises InvalidRequest
    (`bad_out`, `bad_rows`, `no_photos`, `options_contradict`), Unprocessable (`pca_...`),
    Misconfigured (`out_unwritable`), and for a folder what loading the extractor and its vocabulary
    raises.
    """
    check_output_path(out, ".safetensors", "a whitening")
    bars = {name: progress.add_task(name, total=None) for name in ("gathering", "reducing")}
    told = lambda what, done, most: progress.update(bars[what], completed=done, total=most)  # noqa: E731
    refused: list[dict[str, str]] = []
    spec = None
    batches: Iterator[Rows]
    if source.is_dir():
        settings = read_settings()
        loaded, centres = _load_extractor(settings, extractor, vocabulary)
        spec = loaded.spec(centres)
        there = list_photos(source)
        dimension = loaded.dimension(centres)
        check_pca_fittable(len(there), dimension, components)
        chosen = sample_rows(len(there), sample_size(dimension, components), SEED)
        photos = [there[number] for number in chosen]
        pixels = decode_pixels(photos, loaded.preprocessing, settings, refused)
        batches = (loaded.describe(batch, centres) for batch in pixels)
    else:
        if extractor is not None or vocabulary is not None:
            raise InvalidRequest(
                "options_contradict", "--extractor, --vocabulary: only for a fit on photos."
            )
        rows = _open_row_file(source)
        dimension = rows.shape[1]
        check_pca_fittable(len(rows), dimension, components)
        chosen = sample_rows(len(rows), sample_size(dimension, components), SEED)
        batches = _read_rows(rows, chosen)
    found = PcaWhiteningFile(
        fit_pca_stream(batches, len(chosen), dimension, components, told), spec
    )
    with atomic_write(out) as file:
        file.write(found.encode())
    return {
        "file": printable_path(out),
        "from_dimension": dimension,
        "dimension": components,
        "rows": found.whitening.rows,
        "explained": found.whitening.explained,
        "sha256": found.whitening.sha256,
        "refused": refused,
    }


def _load_extractor(
    settings: Settings, extractor: str | None, vocabulary: Path | None
) -> tuple[Extractor, ClusterCentres | None]:
    recipe = get_extractor_config(
        extractor or settings.new_map_extractor,
        allow_test_extractors=settings.allow_test_extractors,
    )
    own = load_own_vocabulary(recipe, vocabulary)
    loaded = load_extractor(recipe, settings)
    return loaded, resolve_centres(loaded, own)


def _open_row_file(file: Path) -> Rows:
    """(n, D) descriptors, mapped from the file."""
    try:
        rows: Rows = np.load(file, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InvalidRequest(
            "bad_rows", f"{printable_path(file)} is no .npy file: {error}."
        ) from error
    if not isinstance(rows, np.ndarray) or rows.ndim != 2 or rows.dtype.kind != "f":
        raise InvalidRequest(
            "bad_rows",
            f"{printable_path(file)} does not hold rows of floating point numbers, one for "
            "each photo, as "
            "`placewise describe` writes them.",
        )
    return rows


def _read_rows(rows: Rows, chosen: Any) -> Iterator[Rows]:
    at_once = max(1, READ_BLOCK_BYTES // (4 * rows.shape[1]))
    for begin in range(0, len(chosen), at_once):
        batch = rows[chosen[begin : begin + at_once]].astype(np.float32)
        lengths = np.linalg.norm(batch, axis=1)
        wrong = (lengths > 0) & (np.abs(lengths - 1) > UNIT_NORM_TOLERANCE)
        if wrong.any():
            at = int(np.flatnonzero(wrong)[0])
            raise Unprocessable(
                "bad_rows",
                f"Row {int(chosen[begin + at])} has the length {lengths[at]:.3g}; those of "
                "descriptors are 1. Normalise the rows first.",
            )
        yield batch
