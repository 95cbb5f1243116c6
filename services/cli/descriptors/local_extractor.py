"""Photos to rows of a .npy file by the path of every upload: decoding children, then one batch
after the other. Imports torch.

Extractors for the commands that describe photos without a server, those of added models as well.

Imports torch.

Photos of this machine to pixels, by the decoding children of the extractor.

Files of descriptors, written batch by batch.
"""

from __future__ import annotations

import contextlib
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from sqlalchemy.exc import SQLAlchemyError

from services.cli.output import atomic_write, printable_path
from services.extractor.added_models import AddedModelLoader
from services.extractor.decoder_pool import DecoderPool
from shared.catalog.database_errors import to_unavailable
from shared.catalog.schema import check_schema
from shared.catalog.tables import open_catalog
from shared.config.settings import Settings
from shared.descriptors.backbones import Backbone
from shared.descriptors.extractor import Extractor, choose_device, not_finite_error
from shared.descriptors.inference import PhotoTooLargeForGpu, choose_precision
from shared.descriptors.pca_whitening import PcaProjection, decode_whitening
from shared.descriptors.vocabulary import ClusterCentres
from shared.descriptors.vocabulary_file import (
    VocabularyFile,
    check_vocabulary_fits,
    check_vocabulary_width,
    read_vocabulary,
)
from shared.errors import InvalidRequest, Misconfigured, PlacewiseError, Unprocessable
from shared.extractor_config.configs import ExtractorConfig
from shared.imaging.decode import DecodedPhoto
from shared.imaging.preprocessing import Pixels, Preprocessing
from shared.storage.open_store import open_store


def load_extractor(recipe: ExtractorConfig, settings: Settings) -> Extractor:
    """On the device and in the precision that the settings say; raises what loading it does, and as
    `_added_backbone`.
    """
    device = choose_device(settings.device)
    return Extractor(
        recipe,
        device,
        precision=choose_precision(settings.precision, recipe, device),
        dino_weights=settings.dino_weights,
        backbone=_added_backbone(recipe, settings, device),
    )


def _added_backbone(
    recipe: ExtractorConfig, settings: Settings, device: torch.device
) -> Backbone | None:
    """The model that the recipe names, from the catalog and the store of the settings, which a
    server may be using; None for an extractor that is no added model.

    Misconfigured (`model_missing`), and what the catalog, the store and `AddedModels.load` raise.
    """
    name = recipe.trained.registered if recipe.trained else None
    if name is None:
        return None
    catalog_file = settings.placewise_home / "catalog.sqlite"
    if settings.database_url is None and not catalog_file.exists():
        raise Misconfigured(
            "model_missing",
            f"The model {name!r} is looked for in the catalog of PLACEWISE_HOME, and there is none "
            f"in {settings.placewise_home}. Add it there (`placewise models add CHECKPOINT --name "
            f"{name}`), or describe with the checkpoint itself: gsv:/FOLDER/FILE.ckpt.",
            model=name,
        )
    with contextlib.closing(open_catalog(settings, "describe")) as catalog:
        try:
            check_schema(catalog)
            store = open_store(settings, exclusive=False)
            return AddedModelLoader(catalog, store, settings).load(name, device)
        except SQLAlchemyError as error:
            unavailable = to_unavailable(error)
            if unavailable is None:
                raise
            raise unavailable from error


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


HLOC_DATASET = "global_descriptor"  # as hloc names it


@contextlib.contextmanager
def open_descriptor_writer(
    file: BinaryIO, shape: tuple[int, int], names: Sequence[str] | None
) -> Iterator[Callable[[Any], None]]:
    """What takes the next (b, D) rows, until all (n, D) of `shape` are there.

    Without names: an `.npy` array. With a name for each row: HDF5, a group of that name for each
    photo with the row in its dataset `global_descriptor`, as hloc's extract_features writes it; a
    `/` in a name is a group within a group.
    """
    if names is None:
        np.lib.format.write_array_header_1_0(
            file, {"descr": "<f4", "fortran_order": False, "shape": shape}
        )
        yield lambda rows: _append_rows(file, rows)
        return
    import h5py  # of the extra `trainer`: rows alone need it not

    left = iter(names)
    with h5py.File(file, "w") as features:

        def write(rows: Any) -> None:
            for row in rows:
                group = features.create_group(next(left))
                group.create_dataset(HLOC_DATASET, data=np.asarray(row, np.float32))

        yield write


def _append_rows(file: BinaryIO, rows: Any) -> None:
    file.write(np.ascontiguousarray(rows, "<f4").tobytes())


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

    `advance` is told how many more photos are done. Raises Unprocessable:
    `refused_photos_error`, which
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
