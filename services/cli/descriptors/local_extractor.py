"""Local feature extraction for commands that run without a server. Imports torch.

Photos take the same path as uploads: child processes decode them, then the extractor describes them
batch by batch, while the next batch is decoded. Descriptors are written as `.npy` or HDF5, batch by
batch.
"""

from __future__ import annotations

import contextlib
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import numpy as np
import torch
from sqlalchemy.exc import SQLAlchemyError

from placewise.protocol import open_file
from services.cli.output import atomic_write, printable_path, utf8_path
from services.extractor.added_models import AddedModelLoader
from services.extractor.decoder_pool import DecoderPool
from shared.catalog.database.errors import explain_outage
from shared.catalog.database.schema import check_schema
from shared.catalog.tables import open_catalog
from shared.config.settings import Settings
from shared.descriptors.backbones import Backbone
from shared.descriptors.extractor import Extractor, choose_device, not_finite_error
from shared.descriptors.inference import PhotoTooLargeForGpu, choose_precision, inference_clock
from shared.descriptors.pca_whitening import PcaProjection, Rows, decode_whitening
from shared.descriptors.side_by_side import SideBySideExtractor
from shared.descriptors.vocabulary import ClusterCentres
from shared.descriptors.vocabulary_file import (
    VocabularyFile,
    check_vocabulary_fits,
    check_vocabulary_width,
    read_vocabulary,
)
from shared.errors import InvalidRequest, Misconfigured, PlacewiseError, Unprocessable
from shared.extractor_config.configs import ExtractorConfig
from shared.extractor_config.names import TORCHSCRIPT_PREFIX
from shared.imaging.decode import DecodedPhoto
from shared.imaging.preprocessing import Pixels, Preprocessing
from shared.storage.copying import hash_file
from shared.storage.open_store import open_store


def load_extractor(config: ExtractorConfig, settings: Settings) -> Extractor:
    """Load an extractor on the device and in the precision of the settings.

    Raises:
        Misconfigured: The weights are missing or don't fit; `model_missing`, `code_not_allowed`.
    """
    if config.parts:
        return SideBySideExtractor(config, [load_extractor(p, settings) for p in config.parts])
    device = choose_device(settings.device)
    return Extractor(
        config,
        device,
        precision=choose_precision(settings.precision, config, device),
        dino_weights=settings.dino_weights,
        backbone=_added_backbone(config, settings, device),
    )


def _added_backbone(
    config: ExtractorConfig, settings: Settings, device: torch.device
) -> Backbone | None:
    """Load an added model from the catalog and store, which may be in use; None for others.

    Raises Misconfigured (`code_not_allowed`) for any TorchScript file that CODE_ALLOWED lacks.
    """
    if config.model is None:
        return None
    if config.model.file is not None and config.model.prefix == TORCHSCRIPT_PREFIX:
        with open_file(Path(config.model.file)) as file:
            settings.check_torchscript_allowed(config.model.extractor, hash_file(file)[1])
    if config.model.registered is None:
        return None
    name, prefix = config.model.registered, config.model.prefix
    catalog_file = settings.placewise_home / "catalog.sqlite"
    if settings.database_url is None and not catalog_file.exists():
        raise Misconfigured(
            "model_missing",
            f"Can't load the model {name!r}: there is no catalog in PLACEWISE_HOME "
            f"({settings.placewise_home}). Add the model there (`placewise models add FILE --name "
            f"{name}`), or use the file itself: {prefix}/FOLDER/FILE.",
            model=name,
        )
    with contextlib.closing(open_catalog(settings, "describe")) as catalog:
        try:
            check_schema(catalog)
            store = open_store(settings, exclusive=False)
            return AddedModelLoader(catalog, store, settings).load(config, device)
        except SQLAlchemyError as error:
            unavailable = explain_outage(error)
            if unavailable is None:
                raise
            raise unavailable from error


DecodeOutcome = DecodedPhoto | PlacewiseError
Photo = TypeVar("Photo")
ReadPhoto = Callable[[Photo], bytes | PlacewiseError]
"""Returns the bytes of a photo, or why they can't be read."""


def read_file(photo: Any) -> bytes | PlacewiseError:
    """Read a photo by its path."""
    try:
        with open_file(photo) as file:
            return file.read()
    except InvalidRequest as error:
        return InvalidRequest("photo_unreadable", error.detail)


def _decode_batches(
    photos: Sequence[Photo],
    preprocessing: Preprocessing,
    settings: Settings,
    seconds: defaultdict[str, float],
    read_photo: ReadPhoto[Photo],
) -> Iterator[list[tuple[Photo, DecodeOutcome]]]:
    """Decode photos in batches, the next one in the background; adds to `seconds["decode"]`."""
    decoders = DecoderPool(settings)

    def read(begin: int) -> list[tuple[Photo, DecodeOutcome]]:
        started = time.perf_counter()
        chunk = photos[begin : begin + settings.batch_photos]
        contents = [read_photo(photo) for photo in chunk]
        readable = [content for content in contents if isinstance(content, bytes)]
        outcomes = iter(decoders.decode(readable, preprocessing))
        batch: list[tuple[Photo, DecodeOutcome]] = [
            (photo, next(outcomes) if isinstance(content, bytes) else content)
            for photo, content in zip(chunk, contents, strict=True)
        ]
        seconds["decode"] += time.perf_counter() - started
        return batch

    with contextlib.closing(decoders), ThreadPoolExecutor(1) as reader:
        begins = range(0, len(photos), settings.batch_photos)
        prefetched = reader.submit(read, 0)
        for begin in begins[1:]:
            batch, prefetched = prefetched.result(), reader.submit(read, begin)
            yield batch
        yield prefetched.result()


def _split_outcomes(
    batch: Sequence[tuple[Photo, DecodeOutcome]], refused: list[tuple[Photo, PlacewiseError]]
) -> list[Pixels]:
    """Return the (height, width, 3) pixels of a batch; its other photos are added to `refused`."""
    pixels = []
    for photo, outcome in batch:
        if isinstance(outcome, PlacewiseError):
            refused.append((photo, outcome))
        else:
            pixels.append(outcome.pixels)
    return pixels


def decode_pixels(
    photos: Sequence[Photo],
    preprocessing: Preprocessing,
    settings: Settings,
    refused: list[tuple[Photo, PlacewiseError]],
    read_photo: ReadPhoto[Photo] = read_file,
) -> Iterator[list[Pixels]]:
    """Decode photos to batches of pixels as `_split_outcomes` does, in the order of the photos."""
    for batch in _decode_batches(photos, preprocessing, settings, defaultdict(float), read_photo):
        if pixels := _split_outcomes(batch, refused):
            yield pixels


def describe_photos(
    photos: Sequence[Photo],
    extractor: Extractor,
    centres: ClusterCentres | None,
    settings: Settings,
    refused: list[tuple[Photo, PlacewiseError]],
    seconds: defaultdict[str, float],
    projection: PcaProjection | None = None,
    read_photo: ReadPhoto[Photo] = read_file,
) -> Iterator[Rows]:
    """Describe photos batch by batch.

    After the first photo that can't be described, the others are only decoded, so that all failures
    can be reported: they are added to `refused`. The times of the stages are added to
    `seconds["decode"]` and `seconds["describe"]`.

    Yields:
        (b, D) float32 rows in the order of the photos.
    """
    clock = inference_clock(extractor.backbone.device)
    batches = _decode_batches(photos, extractor.preprocessing, settings, seconds, read_photo)
    for batch in batches:
        pixels = _split_outcomes(batch, refused)
        if refused or not pixels:
            continue
        started = clock()
        try:
            rows = extractor.describe(pixels, centres, projection)
        except PhotoTooLargeForGpu as error:
            refused.append((batch[error.place][0], error))
            continue
        seconds["describe"] += clock() - started
        for (photo, _), row in zip(batch, rows, strict=True):
            if not np.isfinite(row).all():
                refused.append((photo, not_finite_error()))
        if not refused:
            yield rows


HLOC_DATASET = "global_descriptor"  # hloc's name of the dataset


@contextlib.contextmanager
def _open_descriptor_writer(
    file: BinaryIO, shape: tuple[int, int], names: Sequence[str] | None
) -> Iterator[Callable[[Any], object]]:
    """Open a writer of an (n, D) `.npy` array; call it with successive (b, D) float32 batches.

    With one name per row, HDF5 is written as by hloc's extract_features: a group per photo with the
    dataset `global_descriptor`; a `/` in a name creates a nested group.
    """
    if names is None:
        np.lib.format.write_array_header_1_0(
            file, {"descr": "<f4", "fortran_order": False, "shape": shape}
        )
        yield lambda rows: file.write(np.ascontiguousarray(rows, "<f4").tobytes())
        return
    import h5py  # part of the extra `lab`

    remaining_names = iter(names)
    with h5py.File(file, "w") as features:

        def write(rows: Any) -> None:
            for row in rows:
                group = features.create_group(next(remaining_names))
                group.create_dataset(HLOC_DATASET, data=np.asarray(row, np.float32))

        yield write


def describe_files(
    photos: Sequence[Path],
    out: Path,
    config: ExtractorConfig,
    vocabulary: Path | None,
    pca: Path | None,
    settings: Settings,
    advance: Callable[[int], None],
    *,
    names: Sequence[str] | None = None,
) -> dict[str, Any]:
    """Describe photos and write (photos, dimension) float32 rows to a file atomically.

    Args:
        photos: Photo files, in row order.
        out: Output file: `.npy`, or with `names`, one per photo, HDF5 in hloc's format.
        vocabulary: VLAD vocabulary; None for the shipped one.
        pca: PCA whitening to apply, or None.
        settings: Device, precision, batch size and decoder limits.
        advance: Called with the number of photos of each finished batch.

    Returns:
        `file`, `rows`, `dimension`, the `spec` of the extractor, and the `seconds` of each stage.
        Decoding overlaps with description: the sum may exceed `total`.

    Raises:
        Unprocessable: `photos_refused`, which lists every photo that can't be described with the
            reason; `vocabulary_unusable`; `pca_unusable`.
        Misconfigured: `vocabulary_missing`, `out_unwritable`, and errors of loading the extractor.
    """
    started = time.perf_counter()
    own = load_own_vocabulary(config, vocabulary)
    whitening = decode_whitening(pca.read_bytes()) if pca is not None else None
    extractor = load_extractor(config, settings)
    centres = resolve_centres(extractor, own)
    projection = None
    if whitening is not None:
        whitening.check_compatible(extractor.spec(centres))
        projection = PcaProjection(whitening.whitening, extractor.backbone.device)
    seconds = defaultdict(float, load=time.perf_counter() - started)
    shape = (len(photos), extractor.dimension(centres, projection))
    refused: list[tuple[Path, PlacewiseError]] = []
    with atomic_write(out) as file, _open_descriptor_writer(file, shape, names) as write:
        for rows in describe_photos(
            photos, extractor, centres, settings, refused, seconds, projection
        ):
            write(rows)
            advance(len(rows))
        if refused:
            raise _refused_photos_error(refused, len(photos))
    seconds["total"] = time.perf_counter() - started
    return {
        "file": printable_path(out),
        "rows": len(photos),
        "dimension": shape[1],
        "spec": extractor.spec(centres, projection),
        "seconds": {stage: round(duration, 3) for stage, duration in seconds.items()},
    }


def load_own_vocabulary(config: ExtractorConfig, vocabulary: Path | None) -> VocabularyFile | None:
    """Read the vocabulary file that the user has named; None if there is none and none is required.

    An extractor that uses no vocabulary, or ships one, requires none.

    Raises:
        Unprocessable: `vocabulary_unusable` if it does not match the extractor.
        Misconfigured: `vocabulary_missing` if the extractor needs one and none is given.
    """
    if vocabulary is not None:
        if not config.needs_vocabulary:
            raise Unprocessable(
                "vocabulary_unusable", f"The extractor {config.name} does not use a vocabulary."
            )
        own = read_vocabulary(vocabulary)
        check_vocabulary_width(own.centres, config, config.width)  # before the weights are loaded
        return own
    if config.needs_vocabulary and config.shipped_vocabulary is None:
        raise Misconfigured(
            "vocabulary_missing",
            f"The extractor {config.name} requires a vocabulary and ships none. Pass --vocabulary "
            "FILE, or use --aggregator gem, which needs none.",
        )
    return None


def resolve_centres(extractor: Extractor, own: VocabularyFile | None) -> ClusterCentres | None:
    """The cluster centres of the file, or else the shipped ones; None if none are needed.

    Raises:
        Unprocessable: `vocabulary_unusable` if the file's vocabulary does not match the extractor.
    """
    if own is not None:
        check_vocabulary_fits(own.provenance, own.centres, extractor)
        return own.centres
    if not extractor.config.needs_vocabulary:
        return None
    shipped = extractor.shipped_vocabulary()
    assert shipped is not None, "load_own_vocabulary checked that one is shipped"
    return shipped[0]


def _refused_photos_error(refused: list[tuple[Path, PlacewiseError]], photos: int) -> Unprocessable:
    listing = "\n".join(f"{printable_path(photo)}: {error.detail}" for photo, error in refused)
    return Unprocessable(
        "photos_refused",
        f"{len(refused)} of {photos} photos can't be described. No file was written.\n{listing}",
        refused=[
            {"photo": utf8_path(photo), "code": error.code, "detail": error.detail}
            for photo, error in refused
        ],
    )
