"""Descriptors kept from run to run, by the photo's bytes and by all that decides their value.

One SQLite file for each specification: killed at any moment, it holds whole rows or none. What was
used longest ago goes first when all of them outgrow their limit.
"""

from __future__ import annotations

import hashlib
import json
import sqlite3
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from shared.config.private_files import FILE_MODE, make_private_folder
from shared.errors import InvalidRequest
from shared.evaluation.ranking import DescribeFunction, Rows

BATCH = 32  # rows that are read from the cache together
ROW_OVERHEAD_BYTES = 100  # of SQLite, for a row: key, page slack
BUSY_TIMEOUT_SECONDS = 60.0

SCHEMA = """
CREATE TABLE IF NOT EXISTS rows (photo BLOB PRIMARY KEY, row BLOB NOT NULL);
CREATE TABLE IF NOT EXISTS times (seconds REAL NOT NULL, photos INT NOT NULL);
"""


class TimedDescriber(DescribeFunction, Protocol):
    """A Describe that says what its network took."""

    seconds: float
    photos: int


class CachedDescriber:
    """A Describe that asks `inner` only for photos whose row is not there yet."""

    def __init__(
        self, inner: TimedDescriber, folder: Path, spec: Mapping[str, Any], *, most_bytes: int
    ) -> None:
        """`spec` is everything that decides a row's value; `most_bytes` is for all specs in
        `folder`. Beyond them, rows are made and not kept."""
        self._inner = inner
        self._folder = folder
        named = hashlib.sha256(json.dumps(spec, sort_keys=True).encode()).hexdigest()
        self._file = folder / f"{named[:32]}.sqlite"
        self._most_bytes = most_bytes
        self.on_lookup: Callable[[int, int], None] = lambda done, most: None
        """hears how many photos have been looked for, before the first row comes"""

    def __call__(self, photos: Sequence[Path]) -> Iterator[Rows]:
        kept = self._open()
        try:
            keys, missing = [], []
            for photo in photos:
                keys.append(_photo_sha256(photo))
                missing.append(not _has_row(kept, keys[-1]))
                self.on_lookup(len(keys), len(photos))
            made = self._made([p for p, m in zip(photos, missing, strict=True) if m])
            for begin in range(0, len(photos), BATCH):
                rows, new = [], []
                for place in range(begin, min(begin + BATCH, len(photos))):
                    if missing[place]:
                        rows.append(next(made))
                        new.append((keys[place], rows[-1].tobytes()))
                    else:
                        rows.append(_load_row(kept, keys[place]))
                yield np.stack(rows)
                self._keep(kept, new)  # not before: whoever takes them may find that they are bad
        finally:
            kept.close()

    def milliseconds_a_photo(self) -> float | None:
        """What the network took, over all photos that were ever described for this cache; None
        where nothing was."""
        kept = self._open()
        try:
            seconds, photos = kept.execute("SELECT sum(seconds), sum(photos) FROM times").fetchone()
        finally:
            kept.close()
        return 1000 * seconds / photos if photos else None

    def _made(self, photos: Sequence[Path]) -> Iterator[Any]:
        if not photos:
            return
        for batch in self._inner(photos):
            yield from np.asarray(batch, np.float32)

    def _open(self) -> sqlite3.Connection:
        make_private_folder(self._folder)
        self._file.touch(FILE_MODE)
        kept = sqlite3.connect(self._file, timeout=BUSY_TIMEOUT_SECONDS, isolation_level=None)
        kept.execute("PRAGMA journal_mode = WAL")
        kept.execute("PRAGMA synchronous = NORMAL")
        kept.executescript(SCHEMA)
        self._file.touch()  # it is the last one to go
        return kept

    def _keep(self, kept: sqlite3.Connection, new: Sequence[tuple[bytes, bytes]]) -> None:
        """Rows and the time they took, in one transaction."""
        if not new:
            return
        has_room = self._make_room(sum(len(row) + ROW_OVERHEAD_BYTES for _, row in new))
        kept.execute("BEGIN IMMEDIATE")
        if has_room:
            kept.executemany("INSERT OR REPLACE INTO rows VALUES (?, ?)", new)
        if self._inner.photos:
            took = (self._inner.seconds, self._inner.photos)
            kept.execute("INSERT INTO times VALUES (?, ?)", took)
        kept.execute("COMMIT")
        self._inner.seconds, self._inner.photos = 0.0, 0

    def _make_room(self, more: int) -> bool:
        """Whether so many bytes more may be kept, after the oldest other specs have gone."""
        others = [file for file in self._folder.glob("*.sqlite") if file != self._file]
        for file in sorted(others, key=lambda file: file.stat().st_mtime):
            if self._size() + more <= self._most_bytes:
                break
            for part in self._folder.glob(f"{file.name}*"):
                part.unlink(missing_ok=True)
        return self._size() + more <= self._most_bytes

    def _size(self) -> int:
        return sum(file.stat().st_size for file in self._folder.glob("*.sqlite*"))


def _photo_sha256(photo: Path) -> bytes:
    try:
        with photo.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256")
    except OSError as error:
        raise InvalidRequest(
            "photo_unreadable", f"{photo} can't be read: {error.strerror}."
        ) from error
    return digest.digest()


def _has_row(kept: sqlite3.Connection, key: bytes) -> bool:
    return kept.execute("SELECT 1 FROM rows WHERE photo = ?", (key,)).fetchone() is not None


def _load_row(kept: sqlite3.Connection, key: bytes) -> Any:
    (row,) = kept.execute("SELECT row FROM rows WHERE photo = ?", (key,)).fetchone()
    return np.frombuffer(row, np.float32)
