"""Files of descriptors, written batch by batch."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any, BinaryIO

import numpy as np

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
