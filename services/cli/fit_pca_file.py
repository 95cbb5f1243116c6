"""`placewise pca fit ROWS.npy|DIR --out FILE.safetensors`: a whitening without a server.

Imports torch: only `pca` imports this, when asked.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import Progress

from services.cli.configuration import read_settings
from services.cli.describe_files import centres_of, own_vocabulary
from services.cli.load_extractor import load_extractor
from services.cli.output import shown
from services.cli.photo_files import decoded_batches
from services.cli.photo_places import photo_paths
from services.cli.whole_file import whole_or_nothing
from shared.errors import InvalidRequest, PlacewiseError, Unprocessable
from shared.recipes import get_recipe
from shared.settings import Settings
from shared.vision.extractors import Extractor
from shared.vision.pca import Rows
from shared.vision.pca_file import WhiteningFile
from shared.vision.pca_fit import check_can_fit
from shared.vision.pca_rows import choose_rows, sample_size
from shared.vision.pca_stream import fit_stream
from shared.vision.vocabulary import Centres

READ_BYTES = 16_000_000  # of rows that are read together
UNIT_WITHIN = 0.01  # of a row's length: half precision keeps three digits
SEED = 0  # which rows are learnt from, where there are more than needed


def fit_pca_file(
    source: Path,
    out: Path,
    kept: int,
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
    _check_out(out)
    bars = {name: progress.add_task(name, total=None) for name in ("gathering", "reducing")}
    told = lambda what, done, most: progress.update(bars[what], completed=done, total=most)  # noqa: E731
    refused: list[dict[str, str]] = []
    spec = None
    if source.is_dir():
        settings = read_settings()
        loaded, centres = _load(settings, extractor, vocabulary)
        spec = loaded.spec(centres)
        there = photo_paths(source)
        dimension = loaded.dimension(centres)
        check_can_fit(len(there), dimension, kept)
        chosen = choose_rows(len(there), sample_size(dimension, kept), SEED)
        photos = [there[number] for number in chosen]
        batches = _described(photos, loaded, centres, settings, refused)
    else:
        if extractor is not None or vocabulary is not None:
            raise InvalidRequest(
                "options_contradict", "--extractor, --vocabulary: only for a fit on photos."
            )
        rows = _open_rows(source)
        dimension = rows.shape[1]
        check_can_fit(len(rows), dimension, kept)
        chosen = choose_rows(len(rows), sample_size(dimension, kept), SEED)
        batches = _read(rows, chosen)
    found = WhiteningFile(fit_stream(batches, len(chosen), dimension, kept, told), spec)
    with whole_or_nothing(out) as file:
        file.write(found.encode())
    return {
        "file": shown(out),
        "from_dimension": dimension,
        "dimension": kept,
        "rows": found.whitening.rows,
        "explained": found.whitening.explained,
        "sha256": found.whitening.sha256,
        "refused": refused,
    }


def _load(
    settings: Settings, extractor: str | None, vocabulary: Path | None
) -> tuple[Extractor, Centres | None]:
    recipe = get_recipe(
        extractor or settings.new_map_extractor,
        allow_test_extractors=settings.allow_test_extractors,
    )
    own = own_vocabulary(recipe, vocabulary)
    loaded = load_extractor(recipe, settings)
    return loaded, centres_of(loaded, own)


def _described(
    photos: list[Path],
    extractor: Extractor,
    centres: Centres | None,
    settings: Settings,
    refused: list[dict[str, str]],
) -> Iterator[Rows]:
    """Rows of the photos, batch by batch; those that can't be described join `refused`."""
    for batch in decoded_batches(photos, extractor.preprocessing, settings, defaultdict(float)):
        pixels = []
        for path, outcome in batch:
            if isinstance(outcome, PlacewiseError):
                refused.append({"path": shown(path), "reason": outcome.detail})
            else:
                pixels.append(outcome.pixels)
        if pixels:
            yield extractor.describe(pixels, centres)


def _open_rows(file: Path) -> Rows:
    """(n, D) descriptors, mapped from the file."""
    try:
        rows: Rows = np.load(file, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InvalidRequest("bad_rows", f"{shown(file)} is no .npy file: {error}.") from error
    if not isinstance(rows, np.ndarray) or rows.ndim != 2 or rows.dtype.kind != "f":
        raise InvalidRequest(
            "bad_rows",
            f"{shown(file)} does not hold rows of floating point numbers, one for each photo, as "
            "`placewise describe` writes them.",
        )
    return rows


def _read(rows: Rows, chosen: Any) -> Iterator[Rows]:
    at_once = max(1, READ_BYTES // (4 * rows.shape[1]))
    for begin in range(0, len(chosen), at_once):
        batch = rows[chosen[begin : begin + at_once]].astype(np.float32)
        lengths = np.linalg.norm(batch, axis=1)
        wrong = (lengths > 0) & (np.abs(lengths - 1) > UNIT_WITHIN)
        if wrong.any():
            at = int(np.flatnonzero(wrong)[0])
            raise Unprocessable(
                "bad_rows",
                f"Row {int(chosen[begin + at])} has the length {lengths[at]:.3g}; those of "
                "descriptors are 1. Normalise the rows first.",
            )
        yield batch


def _check_out(out: Path) -> None:
    """Before the minutes that a fit takes."""
    if out.suffix != ".safetensors":
        raise InvalidRequest("bad_out", f"{shown(out)}: a whitening's file ends in .safetensors.")
    if not out.parent.is_dir():
        raise InvalidRequest("bad_out", f"There is no folder {shown(out.parent)}.")
