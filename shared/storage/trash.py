"""The trash of an object store: collected orphans lie there for TRASH_DAYS before they are deleted.

Only orphans go there. What users delete is deleted at once, so that its space is free at once.

The hold: a note in the store that says why orphans are not collected until someone decides.

The steward writes it, `placewise doctor` reads it, and `placewise storage collect --confirm` ends
it.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from datetime import date, datetime
from enum import StrEnum

from shared.errors import NotFound
from shared.storage.folder import OWNER_MARK
from shared.storage.keys import TRASH, key_before_trash, trash_key
from shared.storage.protocol import ObjectInfo, ObjectStore, OwnedStore


@dataclass(slots=True)
class TrashSize:
    objects: int = 0
    size_bytes: int = 0


def move_to_trash(store: OwnedStore, key: str, day: date) -> bool:
    """Move the object to the trash of this day (UTC); False where it is gone already."""
    try:
        store.move(key, trash_key(key, day))
    except NotFound:
        return False
    return True


def measure_trash(store: ObjectStore) -> TrashSize:
    """Count what lies in the trash: walks over it."""
    size = TrashSize()
    for info in store.list(TRASH):
        size.objects += 1
        size.size_bytes += info.size_bytes
    return size


def expire_trash(store: ObjectStore, before: datetime) -> tuple[int, TrashSize]:
    """Delete what was moved to the trash before this time; how many objects, and what is left."""
    deleted, left = 0, TrashSize()
    for info in store.list(TRASH):
        if info.modified_at < before:
            store.delete(info.key)
            deleted += 1
        else:
            left.objects += 1
            left.size_bytes += info.size_bytes
    return deleted, left


def restore_trash(store: OwnedStore, prefix: str = "") -> Iterator[tuple[ObjectInfo, bool]]:
    """Move objects of the trash back to their keys, those whose key begins with `prefix`.

    Yields each with whether it is back; False where another object has its key by now: the one in
    the trash stays there. What is back counts as written now, so that it is not collected again
    before ORPHAN_AGE_SECONDS are over.
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


HOLD = f"{OWNER_MARK}-hold"


class HoldReason(StrEnum):
    SHARE = "share"
    """More than COLLECT_MAX_SHARE of all objects are orphans."""
    ADOPTED = "adopted"
    """A catalog became the owner that did not know some of the objects."""
    CATALOG_BEHIND = "catalog_behind"
    """The catalog is older than the store."""


@dataclass(frozen=True, slots=True)
class Hold:
    reason: HoldReason
    orphans: int
    orphan_bytes: int
    objects: int
    """All objects of the prefixes in which orphans are looked for."""

    def describe(self) -> str:
        """What is held, why, and what the operator can do: whole sentences."""
        why = {
            HoldReason.SHARE: "that is more than COLLECT_MAX_SHARE allows",
            HoldReason.ADOPTED: "this catalog adopted the store without knowing them",
            HoldReason.CATALOG_BEHIND: "the catalog is older than the store",
        }[self.reason]
        return (
            f"{self.orphans} of {self.objects} objects ({self.orphan_bytes / 1e6:.1f} MB) are "
            f"known to no row of the catalog, and {why}: nothing was collected. If the catalog is "
            "not the right one, put the right one back, or run `placewise verify --repair`. If "
            "they are garbage: `placewise storage collect` lists them, and with --confirm it moves "
            "them to the trash."
        )


def read_hold(store: OwnedStore) -> Hold | None:
    note = store.read_note(HOLD)
    if note is None:
        return None
    fields = json.loads(note)
    return Hold(**{**fields, "reason": HoldReason(fields["reason"])})


def write_hold(store: OwnedStore, hold: Hold) -> None:
    store.write_note(HOLD, json.dumps(asdict(hold)).encode())


def end_hold(store: OwnedStore) -> None:
    store.delete_note(HOLD)
