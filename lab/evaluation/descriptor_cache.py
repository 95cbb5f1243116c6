"""On-disk cache of descriptors between evaluation runs, keyed by photo content and extractor spec.

Each spec has one SQLite file, whose transactions keep rows complete if the process is killed. When
the files exceed the size limit, the least recently used file is deleted first.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import sqlite3
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from lab.evaluation.ranking import DescribeFunction, Rows
from shared.config.private_files import FILE_MODE, make_private_folder
from shared.errors import InvalidRequest

BATCH = 32  # rows read from the cache at a time
ROW_OVERHEAD_BYTES = 100  # SQLite's overhead per row: key and unused page space
BUSY_TIMEOUT_SECONDS = 60.0

SCHEMA = """
CREATE TABLE IF NOT EXISTS rows (photo BLOB PRIMARY KEY, row BLOB NOT NULL);
CREATE TABLE IF NOT EXISTS times (seconds REAL NOT NULL, photos INT NOT NULL);
"""


class TimedDescriber(DescribeFunction, Protocol):
    """A DescribeFunction that measures the time spent in its network."""

    seconds: float
    photos: int


class CachedDescriber:
    """DescribeFunction that calls `inner` only for photos whose descriptor is not cached.

    `spec` is everything that determines a descriptor's value. When the folder has `max_bytes`, new
    descriptors are computed but not stored. `on_lookup` is called with the numbers of photos looked
    up so far and in total, before the first descriptor is yielded.
    """

    def __init__(
        self, inner: TimedDescriber, folder: Path, spec: Mapping[str, Any], *, max_bytes: int
    ) -> None:
        self._inner = inner
        self._folder = folder
        spec_hash = hashlib.sha256(json.dumps(spec, sort_keys=True).encode()).hexdigest()
        self._file = folder / f"{spec_hash[:32]}.sqlite"
        self._max_bytes = max_bytes
        self.on_lookup: Callable[[int, int], None] = lambda done, total: None

    def __call__(self, photos: Sequence[Path]) -> Iterator[Rows]:
        """Yield (n, D) float32 descriptors, batch by batch, in the order of the photos."""
        with contextlib.closing(self._open()) as connection:
            keys, missing = [], []
            for photo in photos:
                keys.append(_photo_sha256(photo))
                found = connection.execute("SELECT 1 FROM rows WHERE photo = ?", keys[-1:])
                missing.append(found.fetchone() is None)
                self.on_lookup(len(keys), len(photos))
            computed = self._compute([p for p, m in zip(photos, missing, strict=True) if m])
            for start in range(0, len(photos), BATCH):
                rows, new_rows = [], []
                for index in range(start, min(start + BATCH, len(photos))):
                    if missing[index]:
                        rows.append(next(computed))
                        new_rows.append((keys[index], rows[-1].tobytes()))
                    else:
                        rows.append(_load_row(connection, keys[index]))
                yield np.stack(rows)
                # Stored after the yield: the consumer raises on invalid rows, such as NaN.
                self._store(connection, new_rows)

    def milliseconds_a_photo(self) -> float | None:
        """Return the mean network time per photo over all photos described for this cache.

        None if no time has been recorded.
        """
        with contextlib.closing(self._open()) as connection:
            times = connection.execute("SELECT sum(seconds), sum(photos) FROM times")
            seconds, photos = times.fetchone()
        return 1000 * seconds / photos if photos else None

    def _compute(self, photos: Sequence[Path]) -> Iterator[Any]:
        if not photos:
            return
        for batch in self._inner(photos):
            yield from np.asarray(batch, np.float32)

    def _open(self) -> sqlite3.Connection:
        make_private_folder(self._folder)
        self._file.touch(FILE_MODE)
        connection = sqlite3.connect(self._file, timeout=BUSY_TIMEOUT_SECONDS, isolation_level=None)
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = NORMAL")
        connection.executescript(SCHEMA)
        self._file.touch()  # the modification time is the time of last use
        return connection

    def _store(
        self, connection: sqlite3.Connection, new_rows: Sequence[tuple[bytes, bytes]]
    ) -> None:
        """Store rows and the time of their computation in one transaction."""
        if not new_rows:
            return
        has_space = self._evict_for(sum(len(row) + ROW_OVERHEAD_BYTES for _, row in new_rows))
        connection.execute("BEGIN IMMEDIATE")
        if has_space:
            connection.executemany("INSERT OR REPLACE INTO rows VALUES (?, ?)", new_rows)
        if self._inner.photos:
            timing = (self._inner.seconds, self._inner.photos)
            connection.execute("INSERT INTO times VALUES (?, ?)", timing)
        connection.execute("COMMIT")
        self._inner.seconds, self._inner.photos = 0.0, 0

    def _evict_for(self, new_bytes: int) -> bool:
        """Evict other specs, least recently used first; return whether `new_bytes` fit."""
        others = [file for file in self._folder.glob("*.sqlite") if file != self._file]
        for file in sorted(others, key=lambda file: file.stat().st_mtime):
            if self._total_bytes() + new_bytes <= self._max_bytes:
                break
            for part in self._folder.glob(f"{file.name}*"):
                part.unlink(missing_ok=True)
        return self._total_bytes() + new_bytes <= self._max_bytes

    def _total_bytes(self) -> int:
        return sum(file.stat().st_size for file in self._folder.glob("*.sqlite*"))


def _photo_sha256(photo: Path) -> bytes:
    try:
        with photo.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256")
    except OSError as error:
        raise InvalidRequest(
            "photo_unreadable", f"Can't read {photo}: {error.strerror}."
        ) from error
    return digest.digest()


def _load_row(connection: sqlite3.Connection, key: bytes) -> Any:
    (row,) = connection.execute("SELECT row FROM rows WHERE photo = ?", (key,)).fetchone()
    return np.frombuffer(row, np.float32)
