"""The last state of every journaled row, in a temporary database: a journal may be larger than
memory."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Self
from uuid import UUID

from shared.errors import NotFound, Unavailable
from shared.journal.segments import Line, list_segments, read_segment
from shared.objects import ObjectInfo, ObjectStore
from shared.objects.keys import ORIGINALS, is_original_key

AT_ONCE = 500  # rows
LOOKS = 5  # at a journal that is merged meanwhile

Progress = Callable[[str, int, int], object]
"""Told what is done, how much of it, and of how much."""

SCHEMA = """
PRAGMA synchronous = OFF;
PRAGMA journal_mode = OFF;
CREATE TABLE states (
    table_name TEXT, id TEXT, revision INTEGER, row TEXT, object_key TEXT,
    PRIMARY KEY (table_name, id)
) WITHOUT ROWID;
CREATE INDEX states_object_key ON states (object_key);
CREATE TABLE originals (key TEXT PRIMARY KEY, size_bytes INTEGER, modified_at REAL) WITHOUT ROWID;
"""
ADD = """
INSERT INTO states VALUES (?, ?, ?, ?, ?) ON CONFLICT DO UPDATE SET
    revision = excluded.revision, row = excluded.row, object_key = excluded.object_key
WHERE excluded.revision > states.revision
"""


class LastStates:
    """What the store's journal says, and which originals lie in the store.

    `sequence` is the journal's highest number, 0 without a journal; `installation_id` that of the
    catalog which wrote it; `damaged` names the segments that can't be read.
    """

    def __init__(self) -> None:
        self.sequence = 0
        self.installation_id: UUID | None = None
        self.damaged: list[str] = []
        self._folder = TemporaryDirectory(prefix="placewise-rebuild-")
        self._database = sqlite3.connect(
            Path(self._folder.name) / "states.sqlite", isolation_level=None
        )
        self._database.executescript(SCHEMA)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._database.close()
        self._folder.cleanup()

    def read(self, store: ObjectStore, progress: Progress) -> None:
        """Read the whole journal, and list the originals. Raises Unavailable as the store does."""
        for look in range(LOOKS):
            try:
                self._read_journal(store, progress)
                break
            except NotFound:
                if look == LOOKS - 1:
                    raise
        for some in _batches(store.list(ORIGINALS)):
            self._database.executemany(
                "INSERT OR REPLACE INTO originals VALUES (?, ?, ?)",
                (
                    (info.key, info.size_bytes, info.modified_at.timestamp())
                    for info in some
                    if is_original_key(info.key)
                ),
            )

    def _read_journal(self, store: ObjectStore, progress: Progress) -> None:
        self.damaged = []
        segments = list_segments(store)
        for done, segment in enumerate(segments, start=1):
            try:
                content = read_segment(store, segment.key)
            except Unavailable as error:
                if error.code != "journal_damaged":
                    raise
                self.damaged.append(segment.key)
            else:
                self.installation_id = content.installation_id
                self._add(content.lines)
            self.sequence = max(self.sequence, segment.last)
            progress("journal segments", done, len(segments))

    def _add(self, lines: Iterable[Line]) -> None:
        self._database.execute("BEGIN")
        self._database.executemany(
            ADD,
            (
                (
                    line.table,
                    str(line.id),
                    line.revision,
                    json.dumps(line.row),
                    line.row.get("object_key"),
                )
                for line in lines
            ),
        )
        self._database.execute("COMMIT")

    def count(self, table: str) -> int:
        """How many rows of the table the journal knows."""
        return int(
            self._database.execute(
                "SELECT count(*) FROM states WHERE table_name = ?", (table,)
            ).fetchone()[0]
        )

    def lines(self, table: str) -> Iterator[list[Line]]:
        """The last states of the table's rows, some at a time, by id."""
        rows = self._database.execute(
            "SELECT id, revision, row FROM states WHERE table_name = ? ORDER BY id", (table,)
        )
        while some := rows.fetchmany(AT_ONCE):
            yield [Line(table, UUID(id_), revision, json.loads(row)) for id_, revision, row in some]

    def stored(self, keys: Iterable[str]) -> set[str]:
        """Those of the originals that lie in the store."""
        return {
            key
            for key in keys
            if self._database.execute("SELECT 1 FROM originals WHERE key = ?", (key,)).fetchone()
        }

    def unnamed_originals(self, before: float) -> list[tuple[str, int, float]]:
        """Key, size and time of the originals that the journal does not name and that are older
        than `before` (seconds since 1970)."""
        found: list[tuple[str, int, float]] = self._database.execute(
            "SELECT key, size_bytes, modified_at FROM originals WHERE modified_at < ? AND NOT"
            " EXISTS (SELECT 1 FROM states WHERE states.object_key = originals.key) ORDER BY key",
            (before,),
        ).fetchall()
        return found


def _batches(infos: Iterator[ObjectInfo]) -> Iterator[list[ObjectInfo]]:
    some: list[ObjectInfo] = []
    for info in infos:
        some.append(info)
        if len(some) == AT_ONCE:
            yield some
            some = []
    yield some
