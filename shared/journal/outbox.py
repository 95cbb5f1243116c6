"""Writing pending rows into the journal."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from functools import partial

from sqlalchemy import bindparam, exists, literal, select, union_all, update
from sqlalchemy.orm import Session

from shared.catalog.installation import REBUILDING, Installation, get_or_create_installation
from shared.catalog.session import Catalog
from shared.journal.lag import Lag, lag_of
from shared.journal.segments import (
    MERGED_FROM,
    Line,
    list_segments,
    merge_segments,
    put_segment,
)
from shared.journal.tables import TABLES, line_of, table_of
from shared.objects import ObjectStore

log = logging.getLogger(__name__)

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
