"""Journal segments: gzip files of JSON lines in the object store, and the rows that they contain.

```
journal/<first>-<last>-<uuid>.jsonl.gz     sequence numbers of 12 digits
{"placewise_journal": 1, "installation_id": "..."}
{"table": "photos", "id": "...", "revision": 3, "row": {"filename": "...", ...}}
```

The UUID prevents two processes that write the same number from overwriting each other's segment.
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
from math import isfinite
from typing import Any
from uuid import UUID

from sqlalchemy import (
    BigInteger,
    Boolean,
    Column,
    Float,
    Integer,
    RowMapping,
    String,
    Table,
    TypeDecorator,
)

from shared.catalog.database.base import Journaled, from_json, to_json
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
GZIP_LEVEL = 6

MIN_SEGMENTS_TO_MERGE = 100  # segments smaller than FULL_SEGMENT_BYTES
FULL_SEGMENT_BYTES = 2 * 1024 * 1024  # a segment of this size is not merged again


@dataclass(frozen=True, slots=True, order=True)
class Segment:
    """One object of the journal, with its first and last sequence number (inclusive)."""

    first: int
    last: int
    key: str
    size_bytes: int
    modified_at: datetime


@dataclass(frozen=True, slots=True)
class Line:
    """The state of a row at a revision; `row` has JSON values by column name."""

    table: str
    id: UUID
    revision: int
    row: dict[str, Any]

    def encode(self) -> str:
        """Return the line as JSON, without a line feed."""
        values = {"table": self.table, "id": str(self.id), "revision": self.revision}
        return json.dumps({**values, "row": self.row}, ensure_ascii=False)


@dataclass(frozen=True, slots=True)
class SegmentContent:
    """Decoded content of a segment."""

    installation_id: UUID
    """Id of the catalog that wrote it."""
    lines: list[Line]


def list_segments(store: ObjectStore) -> list[Segment]:
    """Return all segments of the store, sorted by sequence number."""
    segments = []
    for info in store.list(JOURNAL):
        if match := KEY.fullmatch(info.key):
            first, last = int(match[1]), int(match[2])
            segments.append(Segment(first, last, info.key, info.size_bytes, info.modified_at))
    return sorted(segments)


def put_segment(
    store: ObjectStore, first: int, last: int, installation_id: UUID, lines: Iterable[str]
) -> str:
    """Write encoded lines as one segment; return its key."""
    key = f"{JOURNAL}{first:012}-{last:012}-{new_id()}.jsonl.gz"
    head = {"placewise_journal": FORMAT, "installation_id": str(installation_id)}
    text = "\n".join([json.dumps(head), *lines])
    store.put(key, gzip.compress(text.encode(), GZIP_LEVEL, mtime=0))
    return key


def read_segment(store: ObjectStore, key: str) -> SegmentContent:
    """Read and decode a segment.

    Raises:
        NotFound: it was merged into another one meanwhile.
        Unavailable: `journal_damaged` for a damaged segment or an unknown format.
    """
    data = store.get(key)
    number = 0
    try:
        texts = gzip.decompress(data).splitlines()
        number = 1
        head = json.loads(texts[0])
        if head["placewise_journal"] != FORMAT:
            raise ValueError(f"unknown format {head['placewise_journal']}")
        installation_id = UUID(head["installation_id"])
        lines = []
        for number, text in enumerate(texts[1:], start=2):  # noqa: B007 used by the error
            lines.append(_decode_line(text))
    except _DECODE_ERRORS as error:
        reason = f"line {number}: {error!r}" if number else str(error)
        raise Unavailable(
            "journal_damaged",
            f"The journal segment {key} can't be read ({reason}). "
            "Restore the object from a backup.",
            object_key=key,
            reason=reason,
        ) from error
    return SegmentContent(installation_id, lines)


_DECODE_ERRORS = (
    *(OSError, EOFError, zlib.error),
    *(ValueError, LookupError, TypeError, AttributeError, OverflowError, RecursionError),
)


def _decode_line(text: bytes) -> Line:
    """Decode a line whose values fit the columns of its table; raises `_DECODE_ERRORS`."""
    one = json.loads(text)
    line = Line(one["table"], UUID(one["id"]), one["revision"], one["row"])
    if type(line.revision) is not int or not 0 <= line.revision < 2**63:
        raise ValueError(f"revision can't be {line.revision!r:.40}")
    if not isinstance(line.row, dict):
        raise TypeError("row is no object")
    if line.table in TABLES:  # a later release may journal more
        values = columns_of(line)
        missing = sorted(_REQUIRED_COLUMNS[line.table] - values.keys())
        if missing or values.get("id", line.id) != line.id:
            raise ValueError(f"row lacks {', '.join(missing)}" if missing else "row has another id")
        for name, value in values.items():
            _check_value(table_of(line.table).columns[name], value)
    return line


def _check_value(column: Column[Any], value: Any) -> None:
    """Raise TypeError or ValueError for a value that a database can't store in the column."""
    kind = column.type
    if isinstance(kind, TypeDecorator):
        kind = kind.impl_instance
    if value is None:
        is_valid = bool(column.nullable)
    elif isinstance(kind, String):
        value.encode()  # raises for half a surrogate pair
        is_valid = "\0" not in value and (kind.length is None or len(value) <= kind.length)
    elif isinstance(kind, Integer):
        bits = 63 if isinstance(kind, BigInteger) else 31
        is_valid = type(value) is int and abs(value) < 2**bits
    elif isinstance(kind, Float):
        is_valid = type(value) in (int, float) and isfinite(value)
    elif isinstance(kind, Boolean):
        is_valid = type(value) is bool
    else:
        is_valid = not isinstance(value, datetime) or value.tzinfo is not None
    if not is_valid:
        raise ValueError(f"{column.name} can't be {value!r:.40}")


def last_states(lines: Iterable[Line]) -> list[Line]:
    """Return the line with the highest revision of each row."""
    latest: dict[tuple[str, UUID], Line] = {}
    for line in lines:
        known = latest.get((line.table, line.id))
        if known is None or line.revision > known.revision:
            latest[line.table, line.id] = line
    return list(latest.values())


def merge_segments(store: ObjectStore, segments: list[Segment]) -> None:
    """Merge small segments into one if there are at least MIN_SEGMENTS_TO_MERGE of them.

    The merged segment is written before the others are deleted, so that the store has each line at
    least once at any time. Damaged segments are not changed.
    """
    small = [segment for segment in segments if segment.size_bytes < FULL_SEGMENT_BYTES]
    if len(small) < MIN_SEGMENTS_TO_MERGE:
        return
    merged: list[Segment] = []
    lines: list[Line] = []
    size_bytes = 0
    installation_id = None
    for segment in small:
        try:
            content = read_segment(store, segment.key)
        except NotFound:
            return  # another steward is merging them
        except Unavailable as error:
            if error.code != "journal_damaged":
                raise
            log.error("%s", error)
            continue
        merged.append(segment)
        lines += content.lines
        installation_id = content.installation_id
        size_bytes += segment.size_bytes
        if size_bytes >= FULL_SEGMENT_BYTES:
            break
    if len(merged) < 2 or installation_id is None:
        return
    first, last = merged[0].first, max(segment.last for segment in merged)
    states = last_states(lines)
    put_segment(store, first, last, installation_id, (line.encode() for line in states))
    for segment in merged:
        store.delete(segment.key)


# In the order of foreign keys: a table comes after those that it references.
TABLES: dict[str, type[Journaled]] = {
    "models": Model,
    "maps": Map,
    "vocabularies": Vocabulary,
    "whitenings": StoredWhitening,
    "generations": Generation,
    "photos": Photo,
}

# Columns for the catalog's own bookkeeping, which have no meaning in another catalog.
UNJOURNALED_COLUMNS = {
    "photos": {"job_id", "changed_version"},
    "maps": {"version"},
    "generations": {"open_slot", "open_slot_rows", "complete_version", "complete_at"},
}
REVISION_COLUMNS = {"revision", "journaled_revision"}


def table_of(name: str) -> Table:
    """Return the table of this name; KeyError for one that is not journaled."""
    table = TABLES[name].__table__  # type: ignore[attr-defined]
    assert isinstance(table, Table)
    return table


# Those that a row can't be inserted or recovered without.
_REQUIRED_COLUMNS: dict[str, set[str]] = {
    name: {
        column.name
        for column in table_of(name).columns
        if (not column.nullable and column.default is None and column.server_default is None)
        or column.name in ("deleted_at", "vocabulary_id", "model_id", "whitening_id")
    }
    - REVISION_COLUMNS
    - UNJOURNALED_COLUMNS.get(name, set())
    for name in TABLES
}


def line_of(name: str, row: RowMapping) -> Line:
    """Return the current state of a row."""
    excluded = REVISION_COLUMNS | UNJOURNALED_COLUMNS.get(name, set())
    values = {key: to_json(value) for key, value in row.items() if key not in excluded}
    return Line(name, row["id"], row["revision"], values)


def columns_of(line: Line) -> dict[str, Any]:
    """Return the line's values by column name, without the revisions and unknown columns."""
    table = table_of(line.table)
    known = {c.name: c for c in table.columns}
    return {
        name: from_json(known[name], value) for name, value in line.row.items() if name in known
    }
