"""Photos to rows of a .npy file by the path of every upload: decoding children, then one batch
after the other. Imports torch.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from services.cli.load_extractor import load_extractor
from services.cli.output import printable_path
from services.cli.photo_files import decode_batches
from services.cli.row_files import open_descriptor_writer
from services.cli.whole_file import atomic_write
from shared.errors import Misconfigured, PlacewiseError, Unprocessable
from shared.recipes import ExtractorConfig
from shared.settings import Settings
from shared.vision.extractors import Extractor, not_finite_error
from shared.vision.passes import PhotoTooLargeForGpu
from shared.vision.pca import PcaProjection
from shared.vision.pca_file import decode_whitening
from shared.vision.provenance import check_vocabulary_fits, check_vocabulary_width
from shared.vision.vocabulary import ClusterCentres
from shared.vision.vocabulary_file import VocabularyFile, read_vocabulary


@dataclass(slots=True)
class DescriptorFile:
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
            "file": printable_path(self.out),
            "rows": self.rows,
            "dimension": self.spec["dimension"],
            "spec": self.spec,
            "seconds": {stage: round(took, 3) for stage, took in self.seconds.items()},
        }


def describe_files(
    photos: Sequence[Path],
    out: Path,
    recipe: ExtractorConfig,
    vocabulary: Path | None,
    pca: Path | None,
    settings: Settings,
    advance: Callable[[int], None],
    *,
    names: Sequence[str] | None = None,
) -> DescriptorFile:
    """Write (photos, dimension) float32 to `out`, whole or not at all: an `.npy` of rows, or with
    `names`, one for each photo, an `.h5` of hloc's global features.

    `advance` is told how many more photos are done. Raises Unprocessable: `refused_photos_error`, which
    names every photo that can't be described and why; `vocabulary_unfit`, `pca_unfit`;
    Misconfigured: `vocabulary_missing`, `out_unwritable`, and what loading the extractor raises.
    """
    started = time.perf_counter()
    own = load_own_vocabulary(recipe, vocabulary)
    whitening = decode_whitening(pca.read_bytes()) if pca is not None else None
    extractor = load_extractor(recipe, settings)
    centres = resolve_centres(extractor, own)
    projection = None
    if whitening is not None:
        whitening.check_compatible(extractor.spec(centres))
        projection = PcaProjection(whitening.whitening, extractor.backbone.device)
    described = DescriptorFile(out, extractor.spec(centres, projection), len(photos))
    described.seconds["load"] = time.perf_counter() - started
    shape = (len(photos), extractor.dimension(centres, projection))
    refused: list[tuple[Path, PlacewiseError]] = []
    with atomic_write(out) as file, open_descriptor_writer(file, shape, names) as write:
        for batch in decode_batches(photos, extractor.preprocessing, settings, described.seconds):
            pixels = []
            for photo, outcome in batch:
                if isinstance(outcome, PlacewiseError):
                    refused.append((photo, outcome))
                else:
                    pixels.append(outcome.pixels)
            if not refused:  # after a refusal, the rest is read for what else can't be described
                begun = time.perf_counter()
                try:
                    rows = extractor.describe(pixels, centres, projection)
                except PhotoTooLargeForGpu as error:
                    refused.append((batch[error.place][0], error))
                else:
                    for (photo, _), row in zip(batch, rows, strict=True):
                        if not np.isfinite(row).all():
                            refused.append((photo, not_finite_error()))
                    write(rows)
                described.seconds["describe"] += time.perf_counter() - begun
            advance(len(batch))
        if refused:
            raise _refused_photos_error(refused, len(photos))
    described.seconds["total"] = time.perf_counter() - started
    return described


def load_own_vocabulary(recipe: ExtractorConfig, vocabulary: Path | None) -> VocabularyFile | None:
    """The file's; None where the recipe does without, or brings its own.

    Raises Unprocessable (`vocabulary_unfit`) and Misconfigured (`vocabulary_missing`).
    """
    if vocabulary is not None:
        if not recipe.needs_vocabulary:
            raise Unprocessable(
                "vocabulary_unfit", f"The extractor {recipe.name} uses no vocabulary."
            )
        own = read_vocabulary(vocabulary)
        check_vocabulary_width(own.centres, recipe, recipe.width)  # before the weights are loaded
        return own
    if recipe.needs_vocabulary and recipe.shipped_vocabulary is None:
        raise Misconfigured(
            "vocabulary_missing",
            f"The extractor {recipe.name} needs a vocabulary, and none comes with it: "
            "--vocabulary FILE, or --aggregator gem, which does without.",
        )
    return None


def resolve_centres(extractor: Extractor, own: VocabularyFile | None) -> ClusterCentres | None:
    """Those of the file, else the shipped ones; Unprocessable (`vocabulary_unfit`)."""
    if own is not None:
        check_vocabulary_fits(own.provenance, own.centres, extractor)
        return own.centres
    if not extractor.recipe.needs_vocabulary:
        return None
    shipped = extractor.shipped_vocabulary()
    assert shipped is not None, "asked of the recipe before"
    return shipped[0]


def _refused_photos_error(refused: list[tuple[Path, PlacewiseError]], photos: int) -> Unprocessable:
    named = "\n".join(f"{printable_path(photo)}: {error.detail}" for photo, error in refused)
    return Unprocessable(
        "photos_refused",
        f"{len(refused)} of {photos} photos can't be described, and nothing was written.\n{named}",
        refused=[
            {"photo": printable_path(photo), "code": error.code, "detail": error.detail}
            for photo, error in refused
        ],
    )
