"""Measures inputs of the capacity planning on this machine: scan speed, memory besides the rows."""

from __future__ import annotations

import hashlib
import statistics
import time
import tracemalloc
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
from sqlalchemy import insert
from threadpoolctl import threadpool_limits

from benchmarks.report import Report
from services.search.chunk_loader import LoadedChunk
from services.search.dense_scan import scan_top_k
from services.search.photo_columns import PhotoColumns
from shared.catalog.chunks import Chunk, list_live_chunks
from shared.catalog.generations import Generation, GenerationState
from shared.catalog.maps import create_map
from shared.catalog.models import get_or_create_model
from shared.catalog.photos import PhotoFilterValues, PhotoRole
from shared.catalog.schema import migrate
from shared.catalog.session import Catalog
from shared.ids import new_id

if TYPE_CHECKING:
    from rich.progress import Progress

CHUNK_ROWS = 1000
CHUNKS = {7168: 20, 98_304: 2}  # 573 and 786 MB: larger than any CPU cache
ROUNDS = 7
LISTED = 5000
SEED = 20_261_121


def measure(progress: Progress) -> Report:
    """Measure values named as the inputs that they replace; takes seconds and 1 GB of memory."""
    report = Report("This machine")
    bar = progress.add_task("measuring", total=len(CHUNKS) + 3)
    for dimension, chunks in CHUNKS.items():
        report.add(f"scan_us_{dimension}", 1e6 * _scan_seconds(dimension, chunks), "us")
        progress.update(bar, advance=1)
    for name, found, unit in (
        ("photo_columns_bytes", _column_bytes, "B"),
        ("hash_bytes_per_second", _hash_rate, "B/s"),
        ("chunk_list_us", _list_microseconds, "us"),
    ):
        report.add(name, found(), unit)
        progress.update(bar, advance=1)
    return report


def _scan_seconds(dimension: int, chunks: int) -> float:
    """Return the seconds per row of a search that compares all rows with the query."""
    draw = np.random.default_rng(SEED)
    loaded = []
    for _ in range(chunks):
        rows = draw.random((CHUNK_ROWS, dimension), dtype=np.float32)
        rows /= np.linalg.norm(rows, axis=1, keepdims=True)
        columns = PhotoColumns.of(CHUNK_ROWS, enumerate(_facts(CHUNK_ROWS)))
        loaded.append(LoadedChunk(new_id(), "chunks/x", rows, columns))
    query, asked = loaded[0].rows[0], np.ones(chunks * CHUNK_ROWS, bool)
    asked[0] = False  # the query's own photo
    with threadpool_limits(1):
        seconds = _median_seconds(lambda: scan_top_k(loaded, query, 10, asked))
    return seconds / (chunks * CHUNK_ROWS)


def _facts(count: int) -> list[PhotoFilterValues]:
    """Create typical metadata: coordinates, time, a place for every third photo, two tags."""
    return [
        PhotoFilterValues(
            photo_id=new_id(),
            role=PhotoRole.DATABASE,
            deleted_at=None,
            latitude=45.0 + number / 1e6,
            longitude=7.0,
            captured_at=datetime(2026, 11, 21, tzinfo=UTC),
            place=f"place-{number}" if number % 3 == 0 else None,
            tags=["night", f"tag-{number}"] if number % 5 == 0 else [],
        )
        for number in range(count)
    ]


def _column_bytes() -> float:
    """Return the bytes per row of the arrays and of the Python objects that they refer to."""
    count = 5 * CHUNK_ROWS
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        columns = PhotoColumns.of(count, enumerate(_facts(count)))
        used = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    assert len(columns.photo_id) == count
    return used / count


def _hash_rate() -> float:
    data = bytes(CHUNK_ROWS * 4 * 98_304 // 4)
    return len(data) / _median_seconds(lambda: hashlib.sha256(data).digest())


def _list_microseconds() -> float:
    """Return the microseconds per chunk row when a search worker lists a generation's chunks."""
    with TemporaryDirectory() as folder:
        catalog = Catalog(f"sqlite:///{Path(folder) / 'catalog.sqlite'}")
        try:
            migrate(catalog)
            generation_id = _generation_of(catalog, LISTED)

            def list_them() -> None:
                with catalog.read() as session:
                    assert len(list_live_chunks(session, generation_id)) == LISTED

            return 1e6 * _median_seconds(list_them) / LISTED
        finally:
            catalog.close()


def _generation_of(catalog: Catalog, chunks: int) -> Any:
    with catalog.write() as session:
        generation = Generation(
            id=new_id(),
            map_id=create_map(session, "bench", "test-tiny-avg").id,
            state=GenerationState.ACTIVE,
            extractor="bench",
            spec={"clusters": None},
            spec_fingerprint="0" * 64,
            dimension=7168,
            model_id=get_or_create_model(session, "bench", "0" * 64, "MIT", {}).id,
        )
        session.add(generation)
        session.flush()
        session.execute(
            insert(Chunk),
            [
                {
                    "generation_id": generation.id,
                    "slot": slot,
                    "object_key": f"chunks/{slot}.npy",
                    "rows": CHUNK_ROWS,
                    "size_bytes": 1,
                    "sha256": "0" * 64,
                    "sealed": True,
                }
                for slot in range(chunks)
            ],
        )
        return generation.id


def _median_seconds(do: Callable[[], object]) -> float:
    do()  # the first one fills caches
    took = []
    for _ in range(ROUNDS):
        started_at = time.perf_counter()
        do()
        took.append(time.perf_counter() - started_at)
    return statistics.median(took)
