"""Writes pending rows to the journal, and detects a catalog that is older than its object store.

The journal's sequence numbers show the lag: see `catalog_lag`.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime
from functools import partial

from sqlalchemy import bindparam, exists, literal, select, union_all, update
from sqlalchemy.orm import Session

from shared.catalog.database.session import Catalog
from shared.catalog.installation import REBUILDING, Installation, get_or_create_installation
from shared.errors import NotFound, Unavailable
from shared.journal.segments import (
    MIN_SEGMENTS_TO_MERGE,
    TABLES,
    Line,
    Segment,
    line_of,
    list_segments,
    merge_segments,
    put_segment,
    read_segment,
    table_of,
)
from shared.storage import ObjectStore

log = logging.getLogger(__name__)

ROWS_PER_STATEMENT = 500
MAX_LIST_ATTEMPTS = 5  # when segments are merged meanwhile

# Tables whose rows may be deleted without a line in the journal: unused whitenings.
UNJOURNALED_DELETES = {"whitenings"}


@dataclass(frozen=True, slots=True)
class Lag:
    """How far a catalog is behind the journal of its object store."""

    segments: int
    """Upper bound of the journal segments with changes unknown to the catalog."""
    since: datetime | None
    """When the first of them was written; None for an unfinished rebuild."""

    @property
    def detail(self) -> str:
        """Message for the operator: what happened and what to do."""
        if self.since is None:
            return (
                "`placewise storage rebuild` was interrupted. Run it again to resume it. Until "
                "then, nothing is deleted from the object store."
            )
        return (
            f"The catalog is older than the object store: up to {self.segments} journal segments, "
            f"the first written at {self.since:%Y-%m-%d %H:%M:%S} UTC, contain changes that it "
            "lacks. Restore the newer catalog; or run `placewise verify --repair`, which recovers "
            "the missing photos. Until then, nothing is deleted from the object store."
        )


def catalog_lag(catalog: Catalog, store: ObjectStore) -> Lag | None:
    """Return the lag of a catalog; None when it has all changes in the journal.

    A segment whose number the catalog lacks, but whose rows it has, is no lag: a steward was killed
    between writing the segment and its commit.

    Raises:
        Unavailable: as the store; `journal_busy`.
    """
    return _lag_of(catalog, store, list_segments(store))


def _lag_of(catalog: Catalog, store: ObjectStore, segments: list[Segment]) -> Lag | None:
    """Return the lag as `catalog_lag`, for segments that were just listed."""
    for _ in range(MAX_LIST_ATTEMPTS):
        # Read after listing: segments that other stewards have written since are no lag.
        with catalog.read() as session:
            sequence = session.scalar(select(Installation.journal_sequence)) or 0
        if sequence == REBUILDING:
            return Lag(len(segments), None)
        try:
            for segment in segments:
                if segment.last > sequence and not _knows_segment(catalog, store, segment):
                    return Lag(max(s.last for s in segments) - sequence, segment.modified_at)
        except NotFound:  # merged meanwhile
            segments = list_segments(store)
        else:
            return None
    raise Unavailable("journal_busy", "The journal's segments are being merged. Try again.")


def _knows_segment(catalog: Catalog, store: ObjectStore, segment: Segment) -> bool:
    try:
        lines = read_segment(store, segment.key).lines
    except Unavailable as error:
        if error.code != "journal_damaged":
            raise
        return False
    with catalog.read() as session:
        return all(
            _knows_rows(session, lines[begin : begin + ROWS_PER_STATEMENT])
            for begin in range(0, len(lines), ROWS_PER_STATEMENT)
        )


def _knows_rows(session: Session, lines: list[Line]) -> bool:
    for line, known in unknown_lines(session, lines):
        deleted = line.table in UNJOURNALED_DELETES or line.row.get("deleted_at") is not None
        if known is not None or not deleted:
            return False
    return True


def unknown_lines(session: Session, lines: Iterable[Line]) -> list[tuple[Line, Line | None]]:
    """Return the lines that differ from the catalog, each with the catalog's state of the row.

    The state is None where the catalog has no such row. A row with a higher revision is newer than
    the line, which is therefore not returned.
    """
    lines = list(lines)
    unknown: list[tuple[Line, Line | None]] = []
    for name in TABLES:
        table_lines = {line.id: line for line in lines if line.table == name}
        if not table_lines:
            continue
        table = table_of(name)
        rows = session.execute(select(table).where(table.c.id.in_(list(table_lines)))).mappings()
        present = {row["id"]: line_of(name, row) for row in rows}
        for id_, line in table_lines.items():
            known = present.get(id_)
            if known is None or known.revision < line.revision:
                unknown.append((line, known))
            elif known.revision == line.revision:
                common = known.row.keys() & line.row.keys()
                if any(known.row[key] != line.row[key] for key in common):
                    unknown.append((line, known))
    return unknown


LINES_PER_SEGMENT = 5000
TIME_LIMIT_SECONDS = 2.0  # so that the steward's other tasks run in time


@dataclass(frozen=True, slots=True)
class JournalWrite:
    """Result of `write_journal`."""

    lines: int
    """Number of written lines."""
    lag: Lag | None
    """Set where pending rows were not written because the catalog is behind its store."""


def write_journal(catalog: Catalog, store: ObjectStore) -> JournalWrite:
    """Write pending rows for up to TIME_LIMIT_SECONDS; one query when none is pending.

    A segment is written to the store first; then one transaction increments the catalog's sequence
    number and clears the marks. A process that is killed in between leaves a segment whose rows
    are still pending, so that they are written again. A catalog that is behind its store writes
    nothing.

    Raises:
        Unavailable: as the store.
    """
    deadline, written = time.monotonic() + TIME_LIMIT_SECONDS, 0
    while True:
        with catalog.read() as session:
            lines = _pending(session)
            sequence = session.scalar(select(Installation.journal_sequence)) or 0
        if not lines:
            return JournalWrite(written, None)
        segments = list_segments(store)
        lag = _lag_of(catalog, store, segments)
        if lag is not None:
            return JournalWrite(written, lag)
        # The number of a segment that a killed steward left behind is not reused.
        number = max([sequence, *(segment.last for segment in segments)]) + 1
        with catalog.write() as session:
            installation_id = get_or_create_installation(session).id
        key = put_segment(store, number, number, installation_id, (line.encode() for line in lines))
        if not catalog.run(partial(_commit, before=sequence, number=number, lines=lines)):
            store.delete(key)  # another steward was faster; rows it did not write are still pending
            return JournalWrite(written, None)
        written += len(lines)
        if len(segments) + 1 >= MIN_SEGMENTS_TO_MERGE:
            merge_segments(store, list_segments(store))
        if len(lines) < LINES_PER_SEGMENT or time.monotonic() > deadline:
            return JournalWrite(written, None)


def accept_segments(catalog: Catalog, store: ObjectStore) -> None:
    """Set the catalog's sequence number to the store's last segment, whoever wrote it."""
    last = max((segment.last for segment in list_segments(store)), default=0)
    with catalog.write() as session:
        installation = get_or_create_installation(session)
        if installation.journal_sequence != REBUILDING:
            installation.journal_sequence = max(installation.journal_sequence, last)


def _pending(session: Session) -> list[Line]:
    """Return up to LINES_PER_SEGMENT rows whose current state is not in the journal."""
    pending_tables = []
    for name in TABLES:
        table = table_of(name)
        pending = table.c.revision != table.c.journaled_revision
        pending_tables.append(
            select(literal(name)).where(exists(select(table.c.id).where(pending)))
        )
    lines: list[Line] = []
    for name in session.scalars(union_all(*pending_tables)).all():
        table = table_of(name)
        rows = session.execute(
            select(table)
            .where(table.c.revision != table.c.journaled_revision)
            .order_by(table.c.id)
            .limit(LINES_PER_SEGMENT - len(lines))
        )
        lines += [line_of(name, row) for row in rows.mappings()]
    return lines


def _commit(session: Session, before: int, number: int, lines: list[Line]) -> bool:
    """Set the sequence number and clear the marks of the lines.

    Returns False without a change when the sequence number is no longer `before`.
    """
    updated = session.execute(
        update(Installation)
        .where(Installation.journal_sequence == before)
        .values(journal_sequence=number)
        .returning(Installation.number)
    ).all()
    if not updated:
        return False
    _clear_marks(session, lines)
    return True


def _clear_marks(session: Session, lines: list[Line]) -> None:
    """Mark the states of the lines as journaled; rows changed since then stay pending."""
    for name in TABLES:
        table = table_of(name)
        marks = [
            {"row_id": line.id, "journaled": line.revision} for line in lines if line.table == name
        ]
        if marks:
            session.connection().execute(
                update(table)
                .where(
                    table.c.id == bindparam("row_id"),
                    table.c.journaled_revision < bindparam("journaled"),
                )
                # `revision` is set explicitly, or the update would increment it.
                .values(journaled_revision=bindparam("journaled"), revision=table.c.revision),
                marks,
            )
