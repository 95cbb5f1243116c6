"""Fits on local files without a server: VLAD vocabularies and PCA whitenings. Imports torch.

`placewise vocabulary fit DIR` and `placewise models fit-pca` load this module by its name.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import Progress

from lab.cli.descriptors.extractors import load_own_vocabulary, photo_decoder, resolve_centres
from lab.evaluation.results import load_matrix
from lab.training.describing import Refused
from services.cli.descriptors.load_extractor import load_extractor
from services.cli.environment import read_settings
from services.cli.ingest.geotags import list_photos
from services.cli.output import (
    atomic_write,
    check_output_path,
    printable_path,
    stage_bars,
    utf8_path,
)
from shared.config.settings import Settings
from shared.descriptors.extractor import Extractor
from shared.descriptors.patches import fit_vocabulary, sample_photos
from shared.descriptors.pca_fit import check_pca_fittable, fit_pca_stream, sample_rows, sample_size
from shared.descriptors.pca_whitening import PcaWhiteningFile, Rows
from shared.descriptors.vocabulary import ClusterCentres
from shared.errors import InvalidRequest, Unprocessable
from shared.extractor_config.configs import DEFAULT_SAMPLE_PHOTOS, get_extractor_config


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
    """Fit a VLAD vocabulary on the photos below a folder and write it to the `.npz` file `out`.

    Returns:
        The file, its clusters, dimension and provenance, and `refused`: photos that could not be
        decoded.

    Raises:
        InvalidRequest: `no_photos`, `bad_out`.
        Unprocessable: `no_photos`, `vocabulary_unusable`.
        Misconfigured: `out_unwritable`, and errors of loading the extractor.
    """
    check_output_path(out, ".npz", "a vocabulary")
    settings = read_settings()
    config = get_extractor_config(
        extractor or settings.new_map_extractor,
        allow_test_extractors=settings.allow_test_extractors,
    )
    if not config.needs_vocabulary:
        raise Unprocessable(
            "vocabulary_unusable",
            f"The extractor {config.name} does not use a vocabulary: there is nothing to fit.",
        )
    all_photos = list_photos(folder)
    loaded = load_extractor(config, settings)
    seed = seed or 0
    numbers = sample_photos(
        len(all_photos), sample or DEFAULT_SAMPLE_PHOTOS, loaded.backbone.width, seed
    )
    photos = [all_photos[number] for number in numbers]
    refused: Refused = []
    fitted = fit_vocabulary(
        loaded,
        (pixels for _, pixels in photo_decoder(loaded, settings).batches(photos, refused)),
        len(photos),
        clusters=clusters or config.clusters,
        seed=seed,
        on_progress=stage_bars(progress),
    )
    with atomic_write(out) as file:
        file.write(fitted.encode())
    return {
        "file": printable_path(out),
        "clusters": fitted.centres.clusters,
        "dimension": fitted.centres.dimension,
        "provenance": fitted.provenance,
        "refused": _refusals(refused),
    }


READ_BLOCK_BYTES = 16_000_000  # rows are read in blocks of this size
UNIT_NORM_TOLERANCE = 0.01  # half precision has three significant digits
SEED = 0  # of the sample, if there are more rows than needed


def fit_pca_locally(
    source: Path,
    out: Path,
    components: int,
    *,
    extractor: str | None,
    vocabulary: Path | None,
    progress: Progress,
) -> dict[str, Any]:
    """Fit a PCA whitening on an (n, D) `.npy` file or on the photos below a folder.

    The whitening is written to the `.safetensors` file `out`.

    Returns:
        The file, its dimensions, the number of rows, the explained variance, its SHA-256, and
        `refused`: photos that could not be described.

    Raises:
        InvalidRequest: `bad_out`, `bad_rows`, `no_photos`, `options_contradict`.
        Unprocessable: `pca_...`.
        Misconfigured: `out_unwritable`; for a folder, errors of loading the extractor and its
            vocabulary.
    """
    check_output_path(out, ".safetensors", "a whitening")
    refused: Refused = []
    spec = None
    batches: Iterator[Rows]
    if source.is_dir():
        settings = read_settings()
        loaded, centres = _load_extractor(settings, extractor, vocabulary)
        spec = loaded.spec(centres)
        all_photos = list_photos(source)
        dimension = loaded.dimension(centres)
        check_pca_fittable(len(all_photos), dimension, components)
        sampled = sample_rows(len(all_photos), sample_size(dimension, components), SEED)
        photos = [all_photos[number] for number in sampled]
        decoded = photo_decoder(loaded, settings).batches(photos, refused)
        batches = (loaded.describe(pixels, centres) for _, pixels in decoded)
    else:
        if extractor is not None or vocabulary is not None:
            raise InvalidRequest(
                "options_contradict",
                "--extractor and --vocabulary apply only to a fit on photos.",
            )
        rows = load_matrix(
            source,
            "f",
            "bad_rows",
            "a two-dimensional array of floating point numbers, one row per photo, as `placewise "
            "describe` writes it",
        )
        dimension = rows.shape[1]
        check_pca_fittable(len(rows), dimension, components)
        sampled = sample_rows(len(rows), sample_size(dimension, components), SEED)
        batches = _read_rows(rows, sampled)
    fitted = PcaWhiteningFile(
        fit_pca_stream(batches, len(sampled), dimension, components, stage_bars(progress)), spec
    )
    with atomic_write(out) as file:
        file.write(fitted.encode())
    return {
        "file": printable_path(out),
        "from_dimension": dimension,
        "dimension": components,
        "rows": fitted.whitening.rows,
        "explained": fitted.whitening.explained,
        "sha256": fitted.whitening.sha256,
        "refused": _refusals(refused),
    }


def _load_extractor(
    settings: Settings, extractor: str | None, vocabulary: Path | None
) -> tuple[Extractor, ClusterCentres | None]:
    config = get_extractor_config(
        extractor or settings.new_map_extractor,
        allow_test_extractors=settings.allow_test_extractors,
    )
    own = load_own_vocabulary(config, vocabulary)
    loaded = load_extractor(config, settings)
    return loaded, resolve_centres(loaded, own)


def _refusals(refused: Refused) -> list[dict[str, str]]:
    return [{"path": utf8_path(path), "reason": error.detail} for path, error in refused]


def _read_rows(rows: Rows, indices: Any) -> Iterator[Rows]:
    block_rows = max(1, READ_BLOCK_BYTES // (4 * rows.shape[1]))
    for begin in range(0, len(indices), block_rows):
        batch = rows[indices[begin : begin + block_rows]].astype(np.float32)
        norms = np.linalg.norm(batch, axis=1)
        invalid = (norms > 0) & (np.abs(norms - 1) > UNIT_NORM_TOLERANCE)
        if invalid.any():
            at = int(np.flatnonzero(invalid)[0])
            raise Unprocessable(
                "bad_rows",
                f"Row {int(indices[begin + at])} has the L2 norm {norms[at]:.3g} instead of 1. "
                "Normalise the rows first.",
            )
        yield batch
