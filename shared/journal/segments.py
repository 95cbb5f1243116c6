"""Which tables the journal holds, and their rows as lines.

Journal segments: gzip files of JSON lines in the object store. Knows no database.

```
journal/<first>-<last>-<uuid>.jsonl.gz     sequence numbers of 12 digits
{"placewise_journal": 1, "installation_id": "..."}
{"table": "photos", "id": "...", "revision": 3, "row": {"filename": "...", ...}}
```

The UUID keeps two processes that write the same number from overwriting each other.
"""

from __future__ import annotations

import gzip
import json
import logging
import re
import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime
from typing import Any
from uuid import UUID

from sqlalchemy import RowMapping, Table

from shared.catalog.base import Journaled, from_json, to_json
from shared.catalog.generations import Generation
from shared.catalog.maps import Map
from shared.catalog.models import Model
from shared.catalog.photos import Photo
from shared.catalog.vocabularies import StoredWhitening, Vocabulary
from shared.errors import NotFound, Unavailable
from shared.ids import new_id
from shared.storage import ObjectStore
from shared.storage.keys import JOURNAL

log = logging.getLogger(__name__)

FORMAT = 1
KEY = re.compile(rf"{JOURNAL}(\d{{12}})-(\d{{12}})-[0-9a-f-]{{36}}\.jsonl\.gz")
LEVEL = 6  # of gzip

MERGED_FROM = 100  # segments below FULL_BYTES
FULL_BYTES = 2 * 1024 * 1024  # a segment of this size is not merged any more


@dataclass(frozen=True, slots=True, order=True)
class Segment:
    """One object of the journal, with the sequence numbers that it holds, both included."""

    first: int
    last: int
    key: str
    size_bytes: int
    modified_at: datetime


@dataclass(frozen=True, slots=True)
class Line:
    """The state of one row at one revision; `row` holds JSON values by column name."""

    table: str
    id: UUID
    revision: int
    row: dict[str, Any]

    def encode(self) -> str:
        """The line's JSON, without a line feed."""
        values = {"table": self.table, "id": str(self.id), "revision": self.revision}
        return json.dumps({**values, "row": self.row}, ensure_ascii=False)


@dataclass(frozen=True, slots=True)
class SegmentContent:
    installation_id: UUID
    """Of the catalog that wrote it."""
    lines: list[Line]


def list_segments(store: ObjectStore) -> list[Segment]:
    """Every segment in the store, by sequence number."""
    found = []
    for info in store.list(JOURNAL):
        if match := KEY.fullmatch(info.key):
            first, last = int(match[1]), int(match[2])
            found.append(Segment(first, last, info.key, info.size_bytes, info.modified_at))
    return sorted(found)


def put_segment(
    store: ObjectStore, first: int, last: int, installation_id: UUID, lines: Iterable[str]
) -> str:
    """Write encoded lines as one segment; its key."""
    key = f"{JOURNAL}{first:012}-{last:012}-{new_id()}.jsonl.gz"
    head = {"placewise_journal": FORMAT, "installation_id": str(installation_id)}
    text = "\n".join([json.dumps(head), *lines])
    store.put(key, gzip.compress(text.encode(), LEVEL, mtime=0))
    return key


def read_segment(store: ObjectStore, key: str) -> SegmentContent:
    """The segment's content.

    Raises NotFound when it was merged into another one meanwhile, and Unavailable
    (`journal_damaged`) when its bytes are not those of a segment that this release can read.
    """
    data = store.get(key)
    try:
        head, *lines = (json.loads(line) for line in gzip.decompress(data).splitlines())
        if head["placewise_journal"] != FORMAT:
            raise ValueError(f"its format is {head['placewise_journal']}")
        return SegmentContent(
            UUID(head["installation_id"]),
            [Line(one["table"], UUID(one["id"]), one["revision"], one["row"]) for one in lines],
        )
    except (OSError, EOFError, zlib.error, ValueError, KeyError, TypeError) as error:
        raise Unavailable(
            "journal_damaged",
            f"The journal segment {key} can't be read ({error}). Restore the object from a backup.",
            object_key=key,
        ) from error


def last_states(lines: Iterable[Line]) -> list[Line]:
    """Of each row the line with the highest revision."""
    found: dict[tuple[str, UUID], Line] = {}
    for line in lines:
        known = found.get((line.table, line.id))
        if known is None or line.revision > known.revision:
            found[line.table, line.id] = line
    return list(found.values())


def merge_segments(store: ObjectStore, segments: list[Segment]) -> None:
    """Merge small segments into one once there are MERGED_FROM of them.

    The merged segment is written before the others are deleted: at every moment the store holds
    each line at least once. Damaged segments stay as they are.
    """
    small = [segment for segment in segments if segment.size_bytes < FULL_BYTES]
    if len(small) < MERGED_FROM:
        return
    merged: list[Segment] = []
    lines: list[Line] = []
    size_bytes = 0
    installation_id = None
    for segment in small:
        try:
            content = read_segment(store, segment.key)
        except NotFound:
            return  # another steward merges them
        except Unavailable as error:
            if error.code != "journal_damaged":
                raise
            log.error("%s", error)
            continue
        merged.append(segment)
        lines += content.lines
        installation_id = content.installation_id
        size_bytes += segment.size_bytes
        if size_bytes >= FULL_BYTES:
            break
    if len(merged) < 2 or installation_id is None:
        return
    first, last = merged[0].first, max(segment.last for segment in merged)
    states = last_states(lines)
    put_segment(store, first, last, installation_id, (line.encode() for line in states))
    for segment in merged:
        store.delete(segment.key)


# Each after those that its foreign keys lead to.
TABLES: dict[str, type[Journaled]] = {
    "models": Model,
    "maps": Map,
    "vocabularies": Vocabulary,
    "whitenings": StoredWhitening,
    "generations": Generation,
    "photos": Photo,
}

# Of the catalog's own bookkeeping: they mean nothing in another one.
LEFT_OUT = {
    "photos": {"job_id", "changed_version"},
    "maps": {"version"},
    "generations": {"open_slot", "open_slot_rows", "complete_version", "complete_at"},
}
MARKS = {"revision", "journaled_revision"}


def table_of(name: str) -> Table:
    """The table; KeyError for one that the journal does not hold."""
    table = TABLES[name].__table__  # type: ignore[attr-defined]
    assert isinstance(table, Table)
    return table


def line_of(name: str, row: RowMapping) -> Line:
    """The row's present state."""
    left_out = MARKS | LEFT_OUT.get(name, set())
    values = {key: to_json(value) for key, value in row.items() if key not in left_out}
    return Line(name, row["id"], row["revision"], values)


def columns_of(line: Line) -> dict[str, Any]:
    """The row's columns, by name, without the marks; columns that this release does not know are
    left out."""
    table = table_of(line.table)
    known = {c.name: c for c in table.columns}
    return {
        name: from_json(known[name], value) for name, value in line.row.items() if name in known
    }
