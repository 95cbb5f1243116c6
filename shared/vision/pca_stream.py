"""A whitening from rows that come batch by batch: they lie in a temporary folder meanwhile."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path

from shared.objects import FolderStore
from shared.vision.pca import Rows, Whitening
from shared.vision.pca_fit import fit_columns
from shared.vision.pca_rows import StoredColumns, block_width, usable

ROWS = "rows-"


def fit_stream(
    batches: Iterable[Rows],
    most: int,
    dimension: int,
    kept: int,
    told: Callable[[str, int, int], None] = lambda what, done, most: None,
) -> Whitening:
    """The whitening to `kept` dimensions of at most `most` rows, in batches of (n, dimension).

    Rows that say nothing of their photo are passed over. `told` hears what is being done
    (`gathering`, `reducing`), how far it is and where it ends. Raises as `PcaFit` does.
    """
    with tempfile.TemporaryDirectory(prefix="placewise-pca-") as folder:
        store = FolderStore(Path(folder))
        stored = StoredColumns(store, ROWS, dimension, block_width(most, dimension))
        seen = 0
        for batch in batches:
            rows = batch[usable(batch)]
            if len(rows):
                stored.add(rows)
            seen += len(batch)
            told("gathering", seen, most)
        return fit_columns(stored, kept, lambda done, steps: told("reducing", done, steps))
