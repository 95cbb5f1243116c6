"""A whitening from rows that come batch by batch: they lie in a temporary folder meanwhile."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path

from shared.objects import FolderStore
from shared.vision.pca import PcaWhitening, Rows
from shared.vision.pca_fit import fit_pca_columns
from shared.vision.pca_rows import StoredColumns, block_width, usable_rows

ROWS_FOLDER_PREFIX = "rows-"


def fit_pca_stream(
    batches: Iterable[Rows],
    max_rows: int,
    dimension: int,
    kept: int,
    on_progress: Callable[[str, int, int], None] = lambda what, done, max_rows: None,
) -> PcaWhitening:
    """The whitening to `kept` dimensions of at most `max_rows` rows, in batches of (n, dimension).

    Rows that say nothing of their photo are passed over. `on_progress` hears what is being done
    (`gathering`, `reducing`), how far it is and where it ends. Raises as `PcaFit` does.
    """
    with tempfile.TemporaryDirectory(prefix="placewise-pca-") as folder:
        store = FolderStore(Path(folder))
        stored = StoredColumns(
            store, ROWS_FOLDER_PREFIX, dimension, block_width(max_rows, dimension)
        )
        seen = 0
        for batch in batches:
            rows = batch[usable_rows(batch)]
            if len(rows):
                stored.add(rows)
            seen += len(batch)
            on_progress("gathering", seen, max_rows)
        return fit_pca_columns(
            stored, kept, lambda done, steps: on_progress("reducing", done, steps)
        )
