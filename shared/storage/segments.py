"""The journal's objects: `journal/<first>-<last>-<uuid>.jsonl.gz`, and the latest snapshot.

`shared.journal` has their content. The UUID prevents two processes from overwriting each other's
segment.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import datetime

from shared.ids import new_id
from shared.storage.keys import JOURNAL
from shared.storage.protocol import ObjectStore

ENDING, SNAPSHOT_ENDING = ".jsonl.gz", "-snapshot.jsonl.gz"
KEY = re.compile(rf"{JOURNAL}(\d{{12}})-(\d{{12}})-[0-9a-f-]{{36}}({SNAPSHOT_ENDING}|{ENDING})")


@dataclass(frozen=True, slots=True, order=True)
class Segment:
    """One object of the journal, with its first and last sequence number (inclusive)."""

    first: int
    last: int
    key: str
    size_bytes: int
    modified_at: datetime
    is_snapshot: bool


def list_segments(store: ObjectStore) -> list[Segment]:
    """Return the segments and snapshots of the store, sorted by sequence number."""
    return sorted(
        Segment(
            int(match[1]),
            int(match[2]),
            info.key,
            info.size_bytes,
            info.modified_at,
            match[3] == SNAPSHOT_ENDING,
        )
        for info in store.list(JOURNAL)
        if (match := KEY.fullmatch(info.key))
    )


def segment_key(first: int, last: int, *, snapshot: bool = False) -> str:
    """Return a new key for a segment with these sequence numbers."""
    return f"{JOURNAL}{first:012}-{last:012}-{new_id()}{SNAPSHOT_ENDING if snapshot else ENDING}"
