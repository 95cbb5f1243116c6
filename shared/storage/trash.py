"""The trash of an object store, and the hold that suspends garbage collection.

Orphans are moved to the trash and deleted after TRASH_DAYS. Objects of photos that a
user deletes are not moved there: they stay where they are until `Photo.purge_at`.

The hold is a note in the store that gives the reason why orphans are not collected until an
operator decides. The steward writes it, GET /health tells it, and `placewise storage
collect --confirm` ends it.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from datetime import date
from enum import StrEnum

from shared.errors import NotFound
from shared.storage.keys import OWNER_MARK, TRASH, key_before_trash, trash_key
from shared.storage.protocol import ObjectInfo, OwnedStore


def move_to_trash(store: OwnedStore, key: str, day: date) -> bool:
    """Move an object to the trash of this day (UTC); False when it no longer exists."""
    try:
        store.move(key, trash_key(key, day))
    except NotFound:
        return False
    return True


def restore_trash(store: OwnedStore, prefix: str = "") -> Iterator[tuple[ObjectInfo, bool]]:
    """Move objects of the trash whose original keys begin with `prefix` back to these keys.

    A restored object counts as modified now, so that it is not collected again before
    ORPHAN_AGE_SECONDS.

    Yields:
        Each object in the trash, and whether it was restored; False when another object has its
        key now, and it stays in the trash.
    """
    for info in list(store.list(TRASH)):
        key = key_before_trash(info.key)
        if not key.startswith(prefix):
            continue
        is_free = store.head(key) is None
        if is_free:
            try:
                store.move(info.key, key)
            except NotFound:  # deleted or restored by another process
                continue
        yield info, is_free


HOLD_NOTE = f"{OWNER_MARK}-hold"


class HoldReason(StrEnum):
    """Why garbage collection is suspended."""

    SHARE = "share"
    """More than MAX_ORPHAN_SHARE of all objects are orphans."""
    ADOPTED = "adopted"
    """A catalog adopted the store without knowing some of its objects."""


@dataclass(frozen=True, slots=True)
class Hold:
    """A suspension of garbage collection, with the counts at that time."""

    reason: HoldReason
    orphans: int
    orphan_bytes: int
    objects: int
    """All objects under the prefixes that are searched for orphans."""

    def describe(self) -> str:
        """Return sentences for the operator: what happened, why, and what to do."""
        why = {
            HoldReason.SHARE: "they are more than a tenth of all objects",
            HoldReason.ADOPTED: "this catalog adopted the store without knowing them",
        }[self.reason]
        return (
            f"No row of the catalog references {self.orphans} of {self.objects} objects "
            f"({self.orphan_bytes / 1e6:.1f} MB), and {why}: nothing was collected. If this is "
            "the wrong catalog, restore the right one, or run `placewise storage verify --repair`. "
            "If the objects are garbage, `placewise storage collect` lists them, and with "
            "--confirm it moves them to the trash."
        )


def read_hold(store: OwnedStore) -> Hold | None:
    note = store.read_note(HOLD_NOTE)
    if note is None:
        return None
    fields = json.loads(note)
    return Hold(**{**fields, "reason": HoldReason(fields["reason"])})


def write_hold(store: OwnedStore, hold: Hold) -> None:
    store.write_note(HOLD_NOTE, json.dumps(asdict(hold)).encode())


def end_hold(store: OwnedStore) -> None:
    store.delete_note(HOLD_NOTE)
