"""Recovers the rows of the journal: their latest states, and their insertion into the catalog.

The states are collected in a temporary SQLite database, since a journal may be larger than the
memory.
"""

from __future__ import annotations

import json
import sqlite3
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Self
from uuid import UUID

from sqlalchemy import insert, select, update
from sqlalchemy.orm import Session

from shared.catalog.database.base import db_now
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation, GenerationState
from shared.catalog.maps import DELETED_NAME_PREFIX, Map, increment_map_version
from shared.catalog.models import Model
from shared.catalog.photos import Photo
from shared.catalog.vocabularies import StoredWhitening, Vocabulary
from shared.errors import NotFound, Unavailable
from shared.journal.outbox import unknown_lines
from shared.journal.segments import Line, columns_of, list_segments, read_segment, table_of
from shared.storage import ObjectStore
from shared.storage.keys import ORIGINALS, is_original_key

ROWS_PER_STATEMENT = 500
MAX_READ_ATTEMPTS = 5  # when segments are merged meanwhile

Progress = Callable[[str, int, int], object]
"""Progress callback: what is done, number done, total."""

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
UPSERT_STATE = """
INSERT INTO states VALUES (?, ?, ?, ?, ?) ON CONFLICT DO UPDATE SET
    revision = excluded.revision, row = excluded.row, object_key = excluded.object_key
WHERE excluded.revision > states.revision
"""


class LatestStates:
    """The latest state of each journaled row, and the originals in the store.

    Attributes:
        sequence: highest sequence number of the journal, 0 without a journal.
        installation_id: id of the catalog that wrote the journal.
        damaged: keys of unreadable segments, with the reasons.
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

    def __exit__(self, *_: object) -> None:
        self._database.close()
        self._folder.cleanup()

    def read(self, store: ObjectStore, progress: Progress) -> None:
        """Read the journal and list the originals. Raises Unavailable as the store does."""
        for attempt in range(MAX_READ_ATTEMPTS):
            try:
                self._read_journal(store, progress)
                break
            except NotFound:
                if attempt == MAX_READ_ATTEMPTS - 1:
                    raise
        self._database.execute("BEGIN")
        self._database.executemany(
            "INSERT OR REPLACE INTO originals VALUES (?, ?, ?)",
            (
                (info.key, info.size_bytes, info.modified_at.timestamp())
                for info in store.list(ORIGINALS)
                if is_original_key(info.key)
            ),
        )
        self._database.execute("COMMIT")

    def _read_journal(self, store: ObjectStore, progress: Progress) -> None:
        self.damaged = []
        segments = list_segments(store)
        for done, segment in enumerate(segments, start=1):
            try:
                content = read_segment(store, segment.key)
            except Unavailable as error:
                if error.code != "journal_damaged":
                    raise
                self.damaged.append(f"{segment.key} ({error.extra['reason']})")
            else:
                self.installation_id = content.installation_id
                self._add(content.lines)
            self.sequence = max(self.sequence, segment.last)
            progress("journal segments", done, len(segments))

    def _add(self, lines: Iterable[Line]) -> None:
        self._database.execute("BEGIN")
        self._database.executemany(
            UPSERT_STATE,
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
        """Return the number of rows of a table in the journal."""
        return int(
            self._database.execute(
                "SELECT count(*) FROM states WHERE table_name = ?", (table,)
            ).fetchone()[0]
        )

    def lines(self, table: str) -> Iterator[list[Line]]:
        """Iterate over the latest states of a table's rows in batches, by id."""
        rows = self._database.execute(
            "SELECT id, revision, row FROM states WHERE table_name = ? ORDER BY id", (table,)
        )
        while batch := rows.fetchmany(ROWS_PER_STATEMENT):
            yield [
                Line(table, UUID(id_), revision, json.loads(row)) for id_, revision, row in batch
            ]

    def stored_originals(self, keys: Iterable[str]) -> set[str]:
        """Return the keys of the originals that exist in the store."""
        return {
            key
            for key in keys
            if self._database.execute("SELECT 1 FROM originals WHERE key = ?", (key,)).fetchone()
        }

    def unnamed_originals(self, before: float) -> list[tuple[str, int, float]]:
        """Return key, size and time of the originals that no journaled row references.

        Only those modified earlier than `before` (seconds since 1970).
        """
        originals: list[tuple[str, int, float]] = self._database.execute(
            "SELECT key, size_bytes, modified_at FROM originals WHERE modified_at < ? AND NOT"
            " EXISTS (SELECT 1 FROM states WHERE states.object_key = originals.key) ORDER BY key",
            (before,),
        ).fetchall()
        return originals


Columns = dict[str, Any]


@dataclass(slots=True)
class RecoveredRows:
    """Counts of the recovered rows."""

    maps: int = 0
    renamed_maps: dict[str, str] = field(default_factory=dict)
    """New names by old names, of maps whose names other maps have."""
    photos: int = 0
    changed_photos: int = 0
    """Photos that the catalog had in an older state."""
    deleted_photos: int = 0
    """Photos that the catalog had, and that were deleted later."""
    lost_originals: int = 0
    """Photos of the journal whose originals are missing: not recovered."""
    doubled_photos: int = 0
    """Photos whose bytes the map has under another id: not recovered."""
    generations: int = 0
    vocabularies: int = 0


def recover_rows(
    catalog: Catalog,
    store: ObjectStore,
    states: LatestStates,
    recovered: RecoveredRows,
    progress: Progress,
) -> None:
    """Insert and update the rows of every journaled table."""
    rows = _RowRecovery(store, states, recovered)
    for name, prepare in (
        ("models", rows.model),
        ("maps", rows.map),
        ("vocabularies", rows.vocabulary),
        ("whitenings", rows.whitening),
        ("generations", rows.ended_generation),
        ("generations", rows.active_generation),
        ("photos", rows.photo),
    ):
        done, total = 0, states.count(name)
        for lines in states.lines(name):
            with catalog.write() as session:
                rows.begin(session, lines)
                _write(session, name, lines, prepare)
            done += len(lines)
            progress(f"{name} of the journal", done, total)


PrepareRow = Callable[[Session, Line, Line | None, Columns], bool]
"""Returns whether the line is to be written; may change the columns."""


def _write(session: Session, name: str, lines: list[Line], prepare: PrepareRow) -> None:
    table = table_of(name)
    new: dict[frozenset[str], list[Columns]] = defaultdict(list)
    for line, known in unknown_lines(session, lines):
        columns = {**columns_of(line), "revision": line.revision}
        columns["journaled_revision"] = line.revision
        if not prepare(session, line, known, columns):
            continue
        if known is None:
            new[frozenset(columns)].append(columns)
        else:
            session.connection().execute(
                update(table).where(table.c.id == line.id).values(**columns)
            )
    for rows in new.values():
        session.connection().execute(insert(table), rows)


class _RowRecovery:
    """Decides for each line whether it is written, and adapts its columns."""

    def __init__(self, store: ObjectStore, states: LatestStates, recovered: RecoveredRows) -> None:
        self._store = store
        self._states = states
        self._recovered = recovered
        self._existing_models: dict[UUID, UUID] = {}
        self._live_maps: set[UUID] = set()
        self._stored: set[str] = set()
        self._live_bytes: dict[tuple[UUID, str], UUID] = {}
        self._versions: dict[UUID, int] = {}

    def begin(self, session: Session, lines: list[Line]) -> None:
        """Load what the lines of one transaction need."""
        self._live_maps = set(session.scalars(select(Map.id).where(Map.deleted_at.is_(None))))
        self._versions = {}
        if lines[0].table == "photos":
            self._stored = self._states.stored_originals(line.row["object_key"] for line in lines)
            live = session.execute(
                select(Photo.map_id, Photo.sha256, Photo.id).where(
                    Photo.sha256.in_([line.row["sha256"] for line in lines]),
                    Photo.deleted_at.is_(None),
                )
            )
            self._live_bytes = {(row.map_id, row.sha256): row.id for row in live}

    def model(self, session: Session, line: Line, known: Line | None, columns: Columns) -> bool:
        if known is None:
            existing_id = session.scalar(
                select(Model.id).where(
                    Model.name == columns["name"], Model.fingerprint == columns["fingerprint"]
                )
            )
            if existing_id is not None:
                self._existing_models[line.id] = existing_id
                return False
        return True

    def map(self, session: Session, line: Line, known: Line | None, columns: Columns) -> bool:
        if columns["deleted_at"] is not None:
            if known is None:
                return False  # nothing in the catalog refers to it
            columns["name"] = f"{DELETED_NAME_PREFIX}{line.id}"
        elif known is not None and known.row["deleted_at"] is not None:
            return False
        taken_name = session.scalar(
            select(Map.id).where(Map.name == columns["name"], Map.id != line.id)
        )
        if taken_name is not None:
            name = f"{columns['name'][:80]}-{line.id.hex[-8:]}"
            self._recovered.renamed_maps[columns["name"]] = name
            columns |= {"name": name, "revision": line.revision + 1}
        if known is None:
            self._recovered.maps += 1
        return True

    def vocabulary(
        self, session: Session, line: Line, known: Line | None, columns: Columns
    ) -> bool:
        if columns["map_id"] not in self._live_maps:
            return False
        self._recovered.vocabularies += known is None
        return True

    def whitening(self, session: Session, line: Line, known: Line | None, columns: Columns) -> bool:
        return (
            columns["map_id"] in self._live_maps
            and self._store.head(columns["object_key"]) is not None
        )

    def ended_generation(
        self, session: Session, line: Line, known: Line | None, columns: Columns
    ) -> bool:
        if columns["state"] == GenerationState.ACTIVE:
            return False
        if columns["state"] == GenerationState.BUILDING:
            if known is not None:
                return False
            # Its job is not in the journal.
            columns |= {"state": GenerationState.ABANDONED, "revision": line.revision + 1}
            columns["ended_at"] = session.scalar(select(db_now()))
        return self._generation(session, columns, known)

    def active_generation(
        self, session: Session, line: Line, known: Line | None, columns: Columns
    ) -> bool:
        if columns["state"] != GenerationState.ACTIVE:
            return False
        other = session.scalar(
            select(Generation.id).where(
                Generation.map_id == columns["map_id"],
                Generation.state == GenerationState.ACTIVE,
                Generation.id != line.id,
            )
        )
        if other is not None:  # the catalog has activated another generation since
            return False
        return self._generation(session, columns, known)

    def _generation(self, session: Session, columns: Columns, known: Line | None) -> bool:
        if columns["map_id"] not in self._live_maps:
            return False
        columns["model_id"] = self._existing_models.get(columns["model_id"], columns["model_id"])
        for table, name in ((Vocabulary, "vocabulary_id"), (Model, "model_id")):
            if columns[name] is not None and session.get(table, columns[name]) is None:
                return False  # its row is in a damaged segment
        whitening_id = columns["whitening_id"]
        if whitening_id is not None and session.get(StoredWhitening, whitening_id) is None:
            columns["whitening_id"] = None
        self._recovered.generations += known is None
        return True

    def photo(self, session: Session, line: Line, known: Line | None, columns: Columns) -> bool:
        if columns["map_id"] not in self._live_maps:
            return False
        if columns["deleted_at"] is not None:
            if known is None:
                return False
            self._recovered.deleted_photos += known.row["deleted_at"] is None
        elif known is not None and known.row["deleted_at"] is not None:
            return False
        elif known is None:
            if columns["object_key"] not in self._stored:
                self._recovered.lost_originals += 1
                return False
            content = (columns["map_id"], columns["sha256"])
            if self._live_bytes.setdefault(content, line.id) != line.id:
                self._recovered.doubled_photos += 1
                return False
            self._recovered.photos += 1
        else:
            self._recovered.changed_photos += 1
        map_id = columns["map_id"]
        if map_id not in self._versions:
            self._versions[map_id] = increment_map_version(session, map_id)
        columns["changed_version"] = self._versions[map_id]
        return True
