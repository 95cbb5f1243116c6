"""The trash of an object store, and the hold that suspends garbage collection.

Orphans are moved to the trash and deleted after TRASH_DAYS. Objects of photos that a
user deletes are not moved there: they stay where they are until `Photo.purge_at`.

The hold is a note in the store that gives the reason why orphans are not collected until an
operator decides. The steward writes it, GET /health tells it, and `placewise storage
collect --confirm` ends it.
"""

from __future__ import annotations

from collections.abc import Iterator
from datetime import date

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


def read_hold(store: OwnedStore) -> str | None:
    """Return why orphans are not collected, in sentences for the operator; None if they are."""
    note = store.read_note(HOLD_NOTE)
    return None if note is None else note.decode()


def write_hold(store: OwnedStore, reason: str) -> None:
    store.write_note(HOLD_NOTE, reason.encode())


def end_hold(store: OwnedStore) -> None:
    store.delete_note(HOLD_NOTE)
