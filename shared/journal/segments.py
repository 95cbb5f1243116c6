"""Content of the journal's objects: gzip files of JSON lines, and the rows that they contain.

```
{"placewise_journal": 1}
{"table": "photos", "id": "...", "revision": 3, "row": {"filename": "...", ...}}
{"table": "searches", "row": {"id": "...", ...}}                             only in a snapshot
```
"""

from __future__ import annotations

import gzip
import json
import logging
import zlib
from collections.abc import Iterable, Iterator
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

from shared.catalog.api_keys import ApiKey
from shared.catalog.batch_items import BatchItem
from shared.catalog.database.base import Base, Journaled, from_json, to_json
from shared.catalog.generations import Evaluation, Generation
from shared.catalog.idempotency import StoredResponse
from shared.catalog.jobs import Job
from shared.catalog.maps import Map, Search
from shared.catalog.models import Model
from shared.catalog.photos import Photo
from shared.catalog.reconstructions import Reconstruction
from shared.catalog.tracks import Track, TrackFrame
from shared.catalog.vocabularies import StoredWhitening, Vocabulary
from shared.catalog.webhooks import Delivery, Webhook
from shared.errors import NotFound, Unavailable
from shared.storage import ObjectStore
from shared.storage.protocol import writing
from shared.storage.segments import Segment, segment_key

log = logging.getLogger(__name__)

FORMAT = 1
GZIP_LEVEL = 6
GZIP_WBITS = 31  # zlib writes a gzip file

MIN_SEGMENTS_TO_MERGE = 100  # segments smaller than FULL_SEGMENT_BYTES
FULL_SEGMENT_BYTES = 2 * 1024 * 1024  # a segment of this size is not merged again

# In the order of foreign keys: a table comes after those that it references.
TABLES: dict[str, type[Journaled]] = {
    "models": Model,
    "maps": Map,
    "api_keys": ApiKey,
    "webhooks": Webhook,
    "vocabularies": Vocabulary,
    "whitenings": StoredWhitening,
    "generations": Generation,
    "evaluations": Evaluation,
    "photos": Photo,
    "reconstructions": Reconstruction,
}

# Columns for the catalog's own bookkeeping, which have no meaning in another catalog.
UNJOURNALED_COLUMNS = {
    "photos": {"changed_version"},
    "maps": {"version"},
    "generations": {"complete_version", "complete_at"},
}
REVISION_COLUMNS = {"revision", "journaled_revision"}

# Tables whose rows only snapshots have, in the order of foreign keys.
SNAPSHOT_TABLES: dict[str, type[Base]] = {
    "jobs": Job,
    "batch_items": BatchItem,
    "webhook_deliveries": Delivery,
    "idempotency_keys": StoredResponse,
    "searches": Search,
    "tracks": Track,
    "track_frames": TrackFrame,
}


@dataclass(frozen=True, slots=True)
class Line:
    """The state of a row; `row` has JSON values by column name."""

    table: str
    row: dict[str, Any]
    id: UUID | None = None
    revision: int = 0
    """Both are those of a table in `TABLES`."""

    def encode(self) -> str:
        """Return the line as JSON, without a line feed."""
        values: dict[str, Any] = {"table": self.table}
        if self.id is not None:
            values |= {"id": str(self.id), "revision": self.revision}
        return json.dumps({**values, "row": self.row}, ensure_ascii=False)


def table_of(name: str) -> Table:
    """Return the table of this name; KeyError for one that is not in the journal."""
    if name not in TABLES and name not in SNAPSHOT_TABLES:
        raise KeyError(name)
    return Base.metadata.tables[name]


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
    for name in (*TABLES, *SNAPSHOT_TABLES)
}


def line_of(name: str, row: RowMapping) -> Line:
    """Return the current state of a row."""
    excluded = REVISION_COLUMNS | UNJOURNALED_COLUMNS.get(name, set())
    values = {key: to_json(value) for key, value in row.items() if key not in excluded}
    return Line(name, values, row["id"], row["revision"]) if name in TABLES else Line(name, values)


def columns_of(line: Line) -> dict[str, Any]:
    """Return the line's values by column name, without unknown columns."""
    known = table_of(line.table).columns
    return {
        name: from_json(known[name], value) for name, value in line.row.items() if name in known
    }


def put_lines(store: ObjectStore, key: str, lines: Iterable[Line]) -> None:
    """Write a segment or a snapshot."""
    compressor = zlib.compressobj(GZIP_LEVEL, wbits=GZIP_WBITS)
    with writing(store, key) as writer:
        writer.write(compressor.compress(json.dumps({"placewise_journal": FORMAT}).encode()))
        for line in lines:
            writer.write(compressor.compress(f"\n{line.encode()}".encode()))
        writer.write(compressor.flush())


def read_lines(store: ObjectStore, key: str) -> Iterator[Line]:
    """Read and decode a segment or a snapshot line by line.

    Raises:
        NotFound: it was merged into another one meanwhile.
        Unavailable: `journal_damaged` for a damaged segment or an unknown format; the lines before
            the damage were returned.
    """
    number = 0
    try:
        with store.open(key) as file, gzip.open(file) as texts:
            for number, text in enumerate(texts, start=1):
                if number > 1:
                    yield _decode_line(text)
                elif (found := json.loads(text)["placewise_journal"]) != FORMAT:
                    raise ValueError(f"unknown format {found}")
        if not number:
            raise EOFError("it is empty")
    except _DECODE_ERRORS as error:
        reason = f"line {number}: {error!r}" if number else str(error)
        raise Unavailable(
            "journal_damaged",
            f"The journal segment {key} can't be read ({reason}). "
            "Restore the object from a backup.",
            object_key=key,
            reason=reason,
        ) from error


_DECODE_ERRORS = (
    *(gzip.BadGzipFile, EOFError, zlib.error),
    *(ValueError, LookupError, TypeError, AttributeError, OverflowError, RecursionError),
)


def _decode_line(text: bytes) -> Line:
    """Decode a line whose values fit the columns of its table; raises `_DECODE_ERRORS`."""
    one = json.loads(text)
    name = one["table"]
    line = Line(name, one["row"], UUID(one["id"]) if "id" in one else None, one.get("revision", 0))
    if type(line.revision) is not int or not 0 <= line.revision < 2**63:
        raise ValueError(f"revision can't be {line.revision!r:.40}")
    if not isinstance(line.row, dict):
        raise TypeError("row is no object")
    if name in _REQUIRED_COLUMNS:  # a later release may journal more
        values = columns_of(line)
        missing = sorted(_REQUIRED_COLUMNS[name] - values.keys())
        if missing or (name in TABLES and values.get("id", line.id) != line.id):
            raise ValueError(f"row lacks {', '.join(missing)}" if missing else "row has another id")
        for column, value in values.items():
            _check_value(table_of(name).columns[column], value)
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
    latest: dict[tuple[str, UUID | None], Line] = {}
    for line in lines:
        known = latest.get((line.table, line.id))
        if known is None or line.revision > known.revision:
            latest[line.table, line.id] = line
    return list(latest.values())


def merge_segments(
    store: ObjectStore, segments: list[Segment], min_segments: int = MIN_SEGMENTS_TO_MERGE
) -> None:
    """Merge small segments into one if there are at least `min_segments` of them.

    The merged segment is written before the others are deleted, so that the store has each line at
    least once at any time. Damaged segments are not changed.
    """
    small = [s for s in segments if s.size_bytes < FULL_SEGMENT_BYTES and not s.is_snapshot]
    if len(small) < min_segments:
        return
    merged: list[Segment] = []
    lines: list[Line] = []
    size_bytes = 0
    for segment in small:
        try:
            lines += list(read_lines(store, segment.key))
        except NotFound:
            return  # another steward is merging them
        except Unavailable as error:
            if error.code != "journal_damaged":
                raise
            log.error("%s", error)
            continue
        merged.append(segment)
        size_bytes += segment.size_bytes
        if size_bytes >= FULL_SEGMENT_BYTES:
            break
    if len(merged) < 2:
        return
    last = max(segment.last for segment in merged)
    put_lines(store, segment_key(merged[0].first, last), last_states(lines))
    for segment in merged:
        store.delete(segment.key)
