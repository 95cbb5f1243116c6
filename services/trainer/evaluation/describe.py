"""What describes photos, as evaluation sees it, and its rows in memory or in a mapped file."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from shared.errors import PlacewiseError, Unprocessable

MAX_ROWS_IN_MEMORY_BYTES = 1_000_000_000  # rows beyond it lie in a mapped file meanwhile
MAX_PHOTOS_LISTED = 20  # photos that an error lists; the others are counted

Rows = NDArray[np.float32]


class DescribeFunction(Protocol):
    """Photos to their rows, batch by batch, in the photos' order: (b, D) float32, unit length.

    A photo that can't be described is an Unprocessable error (`refused_photos_error`) that names it: a
    figure over the others would be one of another data set.
    """

    def __call__(self, photos: Sequence[Path]) -> Iterator[Rows]: ...


@contextlib.contextmanager
def describe_to_matrix(
    describe: DescribeFunction,
    photos: Sequence[Path],
    *,
    memory_bytes: int = MAX_ROWS_IN_MEMORY_BYTES,
    on_progress: Callable[[int], None] = lambda more: None,
) -> Iterator[Rows]:
    """(photos, D) rows for as long as the block lasts; `on_progress` hears how many more are there.

    Raises Unprocessable (`features_not_finite`, and what `describe` raises).
    """
    with contextlib.ExitStack() as stack:
        rows: Rows = np.empty((0, 0), np.float32)
        done = 0
        for batch in describe(photos):
            if done == 0:
                rows = _allocate_rows(len(photos), batch.shape[1], memory_bytes, stack)
            _check_finite(batch, photos[done : done + len(batch)])
            rows[done : done + len(batch)] = batch
            done += len(batch)
            on_progress(len(batch))
        if done != len(photos):
            raise ValueError(f"{done} rows for {len(photos)} photos")
        yield rows


def _allocate_rows(
    count: int, dimension: int, memory_bytes: int, stack: contextlib.ExitStack
) -> Rows:
    if 4 * count * dimension <= memory_bytes:
        return np.empty((count, dimension), np.float32)
    folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="placewise-rows-"))
    mapped: Rows = np.lib.format.open_memmap(
        Path(folder) / "rows.npy", mode="w+", dtype=np.float32, shape=(count, dimension)
    )
    return mapped


def _check_finite(batch: Rows, photos: Sequence[Path]) -> None:
    finite = np.isfinite(batch).all(axis=1)
    if not finite.all():
        first = photos[int(np.flatnonzero(~finite)[0])]
        raise Unprocessable(
            "features_not_finite",
            f"The network's descriptor of {first} is not finite, and {int((~finite).sum())} of its "
            "batch are not: check the weights; a training that has diverged makes such networks.",
        )


def refused_photos_error(
    refused: Sequence[tuple[Path, PlacewiseError]], photos: int
) -> Unprocessable:
    """The error that names the photos that can't be described, and why."""
    lines = [f"{photo}: {error.detail}" for photo, error in refused[:MAX_PHOTOS_LISTED]]
    if len(refused) > MAX_PHOTOS_LISTED:
        lines.append(f"and {len(refused) - MAX_PHOTOS_LISTED} more")
    return Unprocessable(
        "photos_refused",
        f"{len(refused)} of {photos} photos of the data set can't be described, and without them "
        "it would be another data set. Mend or fetch them again.\n" + "\n".join(lines),
    )
