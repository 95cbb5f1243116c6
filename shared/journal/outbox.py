"""Writes the journal: pending rows as segments, and snapshots."""

from __future__ import annotations

import time
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from functools import partial
from typing import Any

from sqlalchemy import Select, bindparam, exists, literal, or_, select, union_all, update
from sqlalchemy.orm import Session

from shared.catalog.batch_items import BatchItem
from shared.catalog.database.session import NO_TIMEOUTS, Catalog
from shared.catalog.installation import Installation, check_not_behind, get_or_create_installation
from shared.catalog.jobs import Job, JobKind, JobState
from shared.journal.segments import (
    MIN_SEGMENTS_TO_MERGE,
    SNAPSHOT_TABLES,
    TABLES,
    Line,
    line_of,
    merge_segments,
    put_lines,
    table_of,
)
from shared.storage import ObjectStore
from shared.storage.segments import segment_key

LINES_PER_SEGMENT = 5000
TIME_LIMIT_SECONDS = 2.0  # so that the steward's other tasks run in time
ROWS_PER_FETCH = 1000
SNAPSHOT_SECONDS = 3600.0  # a snapshot of a million rows takes half a minute


def write_journal(
    catalog: Catalog, store: ObjectStore, *, min_segments_to_merge: int = MIN_SEGMENTS_TO_MERGE
) -> int:
    """Write pending rows for up to TIME_LIMIT_SECONDS; return their number.

    The catalog takes the segment's number first, then the segment is written to the store, then the
    marks are cleared. A process that is killed in between leaves rows pending, which are written
    again. Two processes that write the same rows do no harm.

    Raises:
        Misconfigured: as `check_not_behind`; nothing is written then.
        Unavailable: as the store.
    """
    deadline, written = time.monotonic() + TIME_LIMIT_SECONDS, 0
    while True:
        with catalog.read() as session:
            lines = _pending(session)
        if not lines:
            return written
        segments = check_not_behind(catalog, store)
        number = _take_number(catalog)
        put_lines(store, segment_key(number, number), lines)
        catalog.run(partial(_clear_marks, lines=lines))
        written += len(lines)
        merge_segments(store, segments, min_segments_to_merge)
        if len(lines) < LINES_PER_SEGMENT or time.monotonic() > deadline:
            return written


def write_snapshot(
    catalog: Catalog, store: ObjectStore, *, max_age_seconds: float = SNAPSHOT_SECONDS
) -> None:
    """Replace the store's snapshot if it is older than this; raises as `write_journal`."""
    snapshots = [segment for segment in check_not_behind(catalog, store) if segment.is_snapshot]
    oldest = datetime.now(UTC) - timedelta(seconds=max_age_seconds)
    if any(snapshot.modified_at > oldest for snapshot in snapshots):
        return
    number = _take_number(catalog)
    with catalog.with_timeouts(NO_TIMEOUTS).read() as session:
        put_lines(store, segment_key(number, number, snapshot=True), snapshot_lines(session))
    for replaced in snapshots:
        store.delete(replaced.key)


def snapshot_lines(session: Session) -> Iterator[Line]:
    """Iterate over the lines of a snapshot: pending rows first, in the order of foreign keys."""
    for name in (*TABLES, *SNAPSHOT_TABLES):
        rows = session.execute(
            _select_for_snapshot(name).execution_options(yield_per=ROWS_PER_FETCH)
        )
        yield from (line_of(name, row) for row in rows.mappings())


def _select_for_snapshot(name: str) -> Select[Any]:
    table = table_of(name)
    if name in TABLES:
        return select(table).where(table.c.revision != table.c.journaled_revision)
    if name != Job.__tablename__:
        return select(table)
    # The photos of queries are not stored. A described photo needs no job, but the batch of a
    # running item reads how its job has ended.
    of_photo = Job.kind.in_((JobKind.INDEX, JobKind.REINDEX))
    of_running_items = select(BatchItem.photo_job_id).where(BatchItem.state == JobState.RUNNING)
    return select(table).where(
        Job.kind != JobKind.DESCRIBE,
        or_(~of_photo, Job.state != JobState.SUCCEEDED, Job.id.in_(of_running_items)),
    )


def _take_number(catalog: Catalog) -> int:
    with catalog.write() as session:
        get_or_create_installation(session)
        return session.execute(
            update(Installation)
            .values(journal_sequence=Installation.journal_sequence + 1)
            .returning(Installation.journal_sequence)
        ).scalar_one()


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
