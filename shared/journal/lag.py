"""Is the catalog older than its object store? The journal's sequence numbers tell."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime

from sqlalchemy import select
from sqlalchemy.orm import Session

from shared.catalog.installation import REBUILDING, Installation
from shared.catalog.session import Catalog
from shared.errors import NotFound, Unavailable
from shared.journal.segments import Line, Segment, list_segments, read_segment
from shared.journal.tables import TABLES, line_of, table_of
from shared.objects import ObjectStore

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
