"""Describes photo files into a `.npy` or HDF5 file, batch by batch. Imports torch."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from lab.cli.descriptors.extractors import load_own_vocabulary, photo_describer, resolve_centres
from lab.evaluation.ranking import check_finite
from services.cli.descriptors.load_extractor import load_extractor
from services.cli.output import atomic_write, printable_path
from shared.config.settings import Settings
from shared.extractor_config.configs import ExtractorConfig

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
        settings: Device, precision, batch size and decoder limits.
        advance: Called with the number of photos of each finished batch.

    Returns:
        `file`, `rows`, `dimension`, the `spec` of the extractor, and the `seconds` of loading it
        (`load`), of description without decoding (`describe`), and in all (`total`).

    Raises:
        Unprocessable: `photos_refused`, which lists every photo that can't be described with the
            reason; `features_not_finite`; `vocabulary_unusable`.
        Misconfigured: `vocabulary_missing`, `out_unwritable`, and errors of loading the extractor.
    """
    started = time.perf_counter()
    own = load_own_vocabulary(config, vocabulary)
    extractor = load_extractor(config, settings)
    centres = resolve_centres(extractor, own)
    loaded = time.perf_counter()
    shape = (len(photos), extractor.dimension(centres))
    describe = photo_describer(extractor, centres, settings)
    done = 0
    with atomic_write(out) as file, _open_descriptor_writer(file, shape, names) as write:
        for rows in describe(photos):
            check_finite(rows, photos[done:])
            write(rows)
            done += len(rows)
            advance(len(rows))
    seconds = {
        "load": loaded - started,
        "describe": describe.seconds,
        "total": time.perf_counter() - started,
    }
    return {
        "file": printable_path(out),
        "rows": len(photos),
        "dimension": shape[1],
        "spec": extractor.spec(centres),
        "seconds": {stage: round(duration, 3) for stage, duration in seconds.items()},
    }
