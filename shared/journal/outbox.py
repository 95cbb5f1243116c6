"""Is the catalog older than its object store? The journal's sequence numbers tell.

Writing pending rows into the journal.
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

from shared.catalog.installation import REBUILDING, Installation, get_or_create_installation
from shared.catalog.session import Catalog
from shared.errors import NotFound, Unavailable
from shared.journal.segments import (
    MERGED_FROM,
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

AT_ONCE = 500  # rows looked up in one statement
LOOKS = 5  # at segments that are merged meanwhile

# Rows that may go without a word in the journal: whitenings that no generation uses any more.
FORGOTTEN = {"whitenings"}


@dataclass(frozen=True, slots=True)
class Lag:
    """By how much a catalog is behind the journal of its object store."""

    segments: int
    """Journal segments with changes that the catalog does not know, at most."""
    since: datetime | None
    """When the first of them was written; None where a rebuild has not finished."""

    @property
    def detail(self) -> str:
        """What happened and what to do."""
        if self.since is None:
            return (
                "`placewise rebuild-catalog` was interrupted. Run it again: it goes on where it "
                "was. Nothing is removed from the object store until then."
            )
        return (
            f"The catalog is older than the object store: up to {self.segments} journal segments, "
            f"the first written at {self.since:%Y-%m-%d %H:%M:%S} UTC, hold changes that it does "
            "not know. Restore the newer catalog; or run `placewise verify --repair`, which takes "
            "the missing photos in again. Nothing is removed from the object store until then."
        )


def catalog_lag(catalog: Catalog, store: ObjectStore) -> Lag | None:
    """By how much the catalog is behind its store; None when it knows all that the journal holds.

    A segment whose number the catalog does not know, but whose rows it does, is no lag: a steward
    died between writing the segment and its commit. Raises Unavailable as the store does.
    """
    return lag_of(catalog, store, list_segments(store))


def lag_of(catalog: Catalog, store: ObjectStore, segments: list[Segment]) -> Lag | None:
    """As `catalog_lag`, of segments that were listed a moment ago."""
    for _ in range(LOOKS):
        # Read after the list: what other stewards have written since is no lag.
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
    raise Unavailable("journal_busy", "The journal's segments are merged again and again.")


def _knows_segment(catalog: Catalog, store: ObjectStore, segment: Segment) -> bool:
    try:
        lines = read_segment(store, segment.key).lines
    except Unavailable as error:
        if error.code != "journal_damaged":
            raise
        return False
    with catalog.read() as session:
        return all(
            _knows_rows(session, lines[begin : begin + AT_ONCE])
            for begin in range(0, len(lines), AT_ONCE)
        )


def _knows_rows(session: Session, lines: list[Line]) -> bool:
    for line, known in unknown_lines(session, lines):
        gone = line.table in FORGOTTEN or line.row.get("deleted_at") is not None
        if known is not None or not gone:
            return False
    return True


def unknown_lines(session: Session, lines: Iterable[Line]) -> list[tuple[Line, Line | None]]:
    """Those lines that say something else than the catalog's rows do, or of which it has no row,
    each with the catalog's state. A row with a higher revision is newer, and so known."""
    lines = list(lines)
    found: list[tuple[Line, Line | None]] = []
    for name in TABLES:
        mine = {line.id: line for line in lines if line.table == name}
        if not mine:
            continue
        table = table_of(name)
        rows = session.execute(select(table).where(table.c.id.in_(list(mine)))).mappings()
        present = {row["id"]: line_of(name, row) for row in rows}
        for id_, line in mine.items():
            known = present.get(id_)
            if known is None or known.revision < line.revision:
                found.append((line, known))
            elif known.revision == line.revision:
                same = known.row.keys() & line.row.keys()
                if any(known.row[key] != line.row[key] for key in same):
                    found.append((line, known))
    return found


LINES = 5000  # of one segment
SLICE_SECONDS = 2.0  # then the steward's other duties have their turn


@dataclass(frozen=True, slots=True)
class Written:
    lines: int
    lag: Lag | None
    """Why nothing was written although rows are pending; None where nothing hinders."""


def write_journal(catalog: Catalog, store: ObjectStore) -> Written:
    """Write every pending row, for a few seconds at most. Costs one query when none is pending.

    A segment is put into the store first; then one transaction raises the catalog's sequence number
    and clears the marks. A process that dies in between leaves a segment with rows that are still
    pending: they are written once more. A catalog that is behind its store writes nothing.

    Raises Unavailable as the store does.
    """
    until, written = time.monotonic() + SLICE_SECONDS, 0
    while True:
        with catalog.read() as session:
            lines = _pending(session)
            sequence = session.scalar(select(Installation.journal_sequence)) or 0
        if not lines:
            return Written(written, None)
        segments = list_segments(store)
        lag = lag_of(catalog, store, segments)
        if lag is not None:
            return Written(written, lag)
        # A segment that a killed steward has left keeps its number.
        number = max([sequence, *(segment.last for segment in segments)]) + 1
        with catalog.write() as session:
            installation_id = get_or_create_installation(session).id
        key = put_segment(store, number, number, installation_id, (line.encode() for line in lines))
        if not catalog.run(partial(_commit, before=sequence, number=number, lines=lines)):
            store.delete(key)  # another steward was faster: what it left out is pending still
            return Written(written, None)
        written += len(lines)
        if len(segments) + 1 >= MERGED_FROM:
            merge_segments(store, list_segments(store))
        if len(lines) < LINES or time.monotonic() > until:
            return Written(written, None)


def accept_segments(catalog: Catalog, store: ObjectStore) -> None:
    """Let the catalog's journal continue after the last segment of the store, whoever wrote it."""
    last = max((segment.last for segment in list_segments(store)), default=0)
    with catalog.write() as session:
        installation = get_or_create_installation(session)
        if installation.journal_sequence != REBUILDING:
            installation.journal_sequence = max(installation.journal_sequence, last)


def _pending(session: Session) -> list[Line]:
    """Up to LINES rows that the journal does not have in their present state."""
    looks = []
    for name in TABLES:
        table = table_of(name)
        pending = table.c.revision != table.c.journaled_revision
        looks.append(select(literal(name)).where(exists(select(table.c.id).where(pending))))
    lines: list[Line] = []
    for name in session.scalars(union_all(*looks)).all():
        table = table_of(name)
        rows = session.execute(
            select(table)
            .where(table.c.revision != table.c.journaled_revision)
            .order_by(table.c.id)
            .limit(LINES - len(lines))
        )
        lines += [line_of(name, row) for row in rows.mappings()]
    return lines


def _commit(session: Session, before: int, number: int, lines: list[Line]) -> bool:
    """Raise the sequence number and clear the marks of these states; False, without any change,
    where the number is not `before` any more."""
    counted = session.execute(
        update(Installation)
        .where(Installation.journal_sequence == before)
        .values(journal_sequence=number)
        .returning(Installation.number)
    ).all()
    if not counted:
        return False
    clear_marks(session, lines)
    return True


def clear_marks(session: Session, lines: list[Line]) -> None:
    """These states are in the journal; rows that were changed since stay pending."""
    for name in TABLES:
        table = table_of(name)
        marks = [
            {"row_id": line.id, "known": line.revision} for line in lines if line.table == name
        ]
        if marks:
            session.connection().execute(
                update(table)
                .where(
                    table.c.id == bindparam("row_id"),
                    table.c.journaled_revision < bindparam("known"),
                )
                # Named, or it would count as a change.
                .values(journaled_revision=bindparam("known"), revision=table.c.revision),
                marks,
            )
