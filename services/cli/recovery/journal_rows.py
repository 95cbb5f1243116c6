"""Recovers the rows of the journal: their latest states, and their insertion into the catalog.

The states are collected in a temporary SQLite database, since a journal may be larger than the
memory.
"""

from __future__ import annotations

import json
import sqlite3
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import groupby, islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Self
from uuid import UUID

from sqlalchemy import Table, exists, or_, select, update
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session

from shared.catalog.chunks import Descriptor
from shared.catalog.database.base import Condition, count_rows, db_now
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation, GenerationState
from shared.catalog.jobs import UNFINISHED_STATES, Job, JobKind, JobState
from shared.errors import NotFound, Unavailable
from shared.jobs.transitions import requeue_job
from shared.journal.segments import SNAPSHOT_TABLES, TABLES, Line, columns_of, read_lines, table_of
from shared.storage import ObjectStore
from shared.storage.keys import ORIGINALS, is_original_key, reconstruction_prefix
from shared.storage.segments import Segment, list_segments

ROWS_PER_STATEMENT = 500
MAX_READ_ATTEMPTS = 5  # when segments are merged meanwhile

# Work in progress: their rows only count if nothing was written to the journal after them.
WORK_TABLES = {"jobs", "batch_items", "webhook_deliveries", "idempotency_keys"}

Progress = Callable[[str, int, int], object]
"""Progress callback: what is done, number done, total."""

Columns = dict[str, Any]

SCHEMA = """
PRAGMA synchronous = OFF;
PRAGMA journal_mode = OFF;
CREATE TABLE states (
    table_name TEXT, id TEXT, revision INTEGER, row TEXT, object_key TEXT,
    PRIMARY KEY (table_name, id)
) WITHOUT ROWID;
CREATE INDEX states_object_key ON states (object_key);
CREATE TABLE originals (key TEXT PRIMARY KEY, modified_at REAL) WITHOUT ROWID;
"""
UPSERT_STATE = """
INSERT INTO states VALUES (?, ?, ?, ?, ?) ON CONFLICT DO UPDATE SET
    revision = excluded.revision, row = excluded.row, object_key = excluded.object_key
WHERE excluded.revision > states.revision
"""


@dataclass(slots=True)
class RecoveryReport:
    """What was recovered, and what could not be."""

    maps: int = 0
    renamed_maps: dict[str, str] = field(default_factory=dict)
    """New names by old names, of maps whose names other maps have."""
    photos: int = 0
    lost_originals: int = 0
    """Photos of the journal whose originals are missing: not recovered."""
    doubled_photos: int = 0
    """Photos whose bytes the map has under another id: not recovered."""
    generations: int = 0
    vocabularies: int = 0
    damaged_segments: list[str] = field(default_factory=list)
    """Keys of unreadable segments, with the reasons."""
    chunks: int = 0
    descriptors: int = 0
    damaged_chunks: list[str] = field(default_factory=list)
    """Keys of chunks that contradict their manifests."""
    unnamed_photos: int = 0
    """Photos that are not in the journal: added to the default map with their EXIF data."""
    unreadable_originals: list[str] = field(default_factory=list)
    """Keys of originals that are not valid photos."""
    unnamed_descriptors: int = 0
    """Rows of chunks whose generations are not in the journal."""
    queued_photos: int = 0
    """Photos without a descriptor, which were queued."""


class LatestStates:
    """The latest state of each row in the journal's segments, and the originals in the store.

    Attributes:
        sequence: highest sequence number of the journal, 0 without a journal.
        snapshot: the latest snapshot, if it is intact.
        damaged: keys of unreadable segments, with the reasons.
    """

    def __init__(self) -> None:
        self.sequence = 0
        self.snapshot: Segment | None = None
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
        for attempt in range(1, MAX_READ_ATTEMPTS + 1):
            try:
                self._read_journal(store, progress)
                break
            except NotFound:  # merged meanwhile
                if attempt == MAX_READ_ATTEMPTS:
                    raise
        self._database.execute("BEGIN")
        self._database.executemany(
            "INSERT OR REPLACE INTO originals VALUES (?, ?)",
            (
                (info.key, info.modified_at.timestamp())
                for info in store.list(ORIGINALS)
                if is_original_key(info.key)
            ),
        )
        self._database.execute("COMMIT")

    def _read_journal(self, store: ObjectStore, progress: Progress) -> None:
        self.damaged = []
        segments = list_segments(store)
        self.snapshot = next((s for s in reversed(segments) if s.is_snapshot), None)
        self.sequence = max((segment.last for segment in segments), default=0)
        for done, segment in enumerate(segments, start=1):
            if not segment.is_snapshot or segment is self.snapshot:
                self._add(store, segment)
            progress("journal segments", done, len(segments))

    def _add(self, store: ObjectStore, segment: Segment) -> None:
        """Add the states of a segment, which is left out as a whole if it is damaged."""
        self._database.execute("BEGIN")
        try:
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
                    for line in read_lines(store, segment.key)
                    if line.id is not None
                ),
            )
            self._database.execute("COMMIT")
        except Unavailable as error:
            self._database.execute("ROLLBACK")
            if error.code != "journal_damaged":
                raise
            self.damaged.append(f"{segment.key} ({error.extra['reason']})")
            if segment is self.snapshot:
                self.snapshot = None

    @property
    def snapshot_is_last(self) -> bool:
        """Whether no segment was written after the snapshot."""
        return self.snapshot is not None and self.snapshot.last == self.sequence

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
                Line(table, json.loads(row), UUID(id_), revision) for id_, revision, row in batch
            ]

    def has_row(self, table: str, row_id: UUID) -> bool:
        """Return whether the journal has a state of the row, deleted or not."""
        found = self._database.execute(
            "SELECT 1 FROM states WHERE table_name = ? AND id = ?", (table, str(row_id))
        )
        return found.fetchone() is not None

    def forget_original(self, key: str) -> None:
        """Treat the original as one that no journaled row has."""
        self._database.execute("UPDATE states SET object_key = NULL WHERE object_key = ?", (key,))

    def has_original(self, key: str) -> bool:
        """Return whether the store has the original."""
        found = self._database.execute("SELECT 1 FROM originals WHERE key = ?", (key,))
        return found.fetchone() is not None

    def unnamed_originals(self) -> list[tuple[str, float]]:
        """Return key and time (seconds since 1970) of the originals that no journaled row has."""
        originals: list[tuple[str, float]] = self._database.execute(
            "SELECT key, modified_at FROM originals WHERE NOT EXISTS"
            " (SELECT 1 FROM states WHERE states.object_key = originals.key) ORDER BY key"
        ).fetchall()
        return originals


def recover_rows(
    catalog: Catalog,
    store: ObjectStore,
    states: LatestStates,
    recovered: RecoveryReport,
    progress: Progress,
) -> None:
    """Insert the rows of the tables in `TABLES`; those that the catalog has already stay."""
    recovered.damaged_segments = states.damaged
    prepare = _RowPreparation(store, states, recovered)
    for name in TABLES:
        table, done, total = table_of(name), 0, states.count(name)
        for lines in states.lines(name):
            rows = {line.id: row for line in lines if (row := prepare(line)) is not None}
            with catalog.write() as session:
                _insert_new_rows(session, table, list(rows.values()))
                present = count_rows(session, select(table.c.id).where(table.c.id.in_(rows)))
            if name in ("maps", "generations", "vocabularies", "photos"):
                setattr(recovered, name, getattr(recovered, name) + present)
            if name == "photos":
                recovered.doubled_photos += len(rows) - present
            done += len(lines)
            progress(f"{name.replace('_', ' ')} of the journal", done, total)


def _insert_new_rows(session: Session, table: Table, rows: list[Columns]) -> None:
    """Insert the rows that violate no unique constraint."""
    dialect = sqlite if session.get_bind().dialect.name == "sqlite" else postgresql
    statement = dialect.insert(table).on_conflict_do_nothing()
    same_columns: dict[frozenset[str], list[Columns]] = defaultdict(list)
    for row in rows:
        same_columns[frozenset(row)].append(row)
    for group in same_columns.values():
        session.connection().execute(statement, group)


class _RowPreparation:
    """Returns the columns of a line's row, or None where it is not to be recovered.

    The journal is consistent, except for its last seconds and for damaged segments.
    """

    def __init__(self, store: ObjectStore, states: LatestStates, recovered: RecoveryReport) -> None:
        self._store = store
        self._states = states
        self._recovered = recovered
        self._map_names: set[str] = set()
        self._ids: dict[str, set[UUID | None]] = {name: set() for name in TABLES}

    def __call__(self, line: Line) -> Columns | None:
        columns = columns_of(line) | {
            "revision": line.revision,
            "journaled_revision": line.revision,
        }
        purge_at = columns.get("purge_at")  # of a photo in the trash, which stays there
        if columns.get("deleted_at") and not (purge_at and purge_at > datetime.now(UTC)):
            return None
        if line.table == "photos":
            return columns if self._is_recoverable_photo(line, columns) else None
        if line.table == "maps":
            self._rename_second_map(columns)
        elif line.table == "whitenings" and self._store.head(columns["object_key"]) is None:
            return None  # deleted, which the journal does not record
        elif line.table == "reconstructions" and not (
            columns.get("finished_at")
            and any(self._store.list(reconstruction_prefix(columns["id"])))
        ):
            return None  # its job begins another one, or it was deleted: see whitenings
        elif line.table == "generations":
            if columns["whitening_id"] not in self._ids["whitenings"]:
                columns["whitening_id"] = None
            building = columns["state"] == GenerationState.BUILDING
            if building and not self._states.snapshot_is_last:  # its job is unknown
                columns |= {"state": GenerationState.ABANDONED, "revision": line.revision + 1}
                columns["ended_at"] = datetime.now(UTC)
        if not self._has_parents(line.table, columns):
            return None
        self._ids[line.table].add(line.id)
        return columns

    def _has_parents(self, name: str, columns: Columns) -> bool:
        return all(
            columns.get(column.name) is None
            or columns[column.name] in self._ids[reference.column.table.name]
            for column in table_of(name).columns
            for reference in column.foreign_keys
        )

    def _rename_second_map(self, columns: Columns) -> None:
        old = columns["name"]
        if old in self._map_names:
            columns["name"] = f"{old[:80]}-{columns['id'].hex[-8:]}"
            columns["revision"] += 1
            self._recovered.renamed_maps[old] = columns["name"]
        self._map_names.add(columns["name"])

    def _is_recoverable_photo(self, line: Line, columns: Columns) -> bool:
        if columns["map_id"] not in self._ids["maps"]:
            if not self._states.has_row("maps", columns["map_id"]):  # it is in a damaged segment
                self._states.forget_original(columns["object_key"])
            return False
        if not self._states.has_original(columns["object_key"]):
            self._recovered.lost_originals += 1
            return False
        return True


def recover_snapshot(
    catalog: Catalog,
    store: ObjectStore,
    states: LatestStates,
    progress: Progress,
) -> None:
    """Insert the rows of the latest snapshot whose photos, maps and jobs were recovered.

    Leases are released. Photos that have been described since need no job.
    """
    if states.snapshot is None:
        return
    with_work = states.snapshot_is_last
    for name, lines in groupby(read_lines(store, states.snapshot.key), lambda line: line.table):
        if name not in SNAPSHOT_TABLES or (name in WORK_TABLES and not with_work):
            continue
        table, done = table_of(name), 0
        while batch := list(islice(lines, ROWS_PER_STATEMENT)):
            with catalog.write() as session:
                rows = _rows_with_parents(session, table, [columns_of(line) for line in batch])
                _insert_new_rows(session, table, rows)
            done += len(batch)
            progress(f"{name.replace('_', ' ')} of the snapshot", done, done)
    with catalog.write() as session:
        for job in session.scalars(select(Job).where(Job.lease_token.is_not(None))):
            requeue_job(job)
        session.execute(
            update(Job)
            .where(Job.state.in_(UNFINISHED_STATES), _is_described())
            .values(state=JobState.SUCCEEDED, finished_at=db_now(), progress_done=1)
            .execution_options(synchronize_session=False)
        )


def _rows_with_parents(session: Session, table: Table, rows: list[Columns]) -> list[Columns]:
    for column in table.columns:
        for reference in column.foreign_keys:
            parents = select(reference.column).where(
                reference.column.in_({row.get(column.name) for row in rows})
            )
            present = {None, *session.scalars(parents)}
            rows = [row for row in rows if row.get(column.name) in present]
    return rows


def _is_described() -> Condition:
    """Condition for jobs of photos that have a descriptor in their generation."""
    return exists().where(
        Job.kind.in_((JobKind.INDEX, JobKind.REINDEX)),
        Descriptor.photo_id == Job.photo_id,
        Descriptor.generation_id == Generation.id,
        or_(
            Generation.id == Job.generation_id,
            Job.generation_id.is_(None) & (Generation.state == GenerationState.ACTIVE),
        ),
    )
