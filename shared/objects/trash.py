"""The trash of an object store: collected orphans lie there for TRASH_DAYS before they are deleted.

Only orphans go there. What users delete is deleted at once, so that its space is free at once.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import date, datetime

from shared.errors import NotFound
from shared.objects.keys import TRASH, key_before_trash, trash_key
from shared.objects.port import ObjectInfo, ObjectStore, OwnedStore


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
