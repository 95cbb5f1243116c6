"""The interface of object stores; one contract test covers all implementations."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import BinaryIO, Protocol


@dataclass(frozen=True, slots=True)
class ObjectInfo:
    """Metadata of a stored object."""

    key: str
    size_bytes: int
    modified_at: datetime
    """Time of the write by the store's clock, UTC."""


class ObjectWriter(Protocol):
    """Writes one object block by block; nothing is visible before `commit`."""

    def write(self, data: bytes) -> None: ...

    def commit(self) -> None:
        """Make the object visible and durable atomically.

        After Unavailable the object is either complete or absent; the caller can't know which.
        """

    def abort(self) -> None:
        """Discard what was written; a no-op after `commit`. Never raises."""


class ObjectStore(Protocol):
    """A store of objects with atomic writes: a crash never leaves a partial object under its key.

    A key consists of names joined by single slashes (`shared.storage.keys.check_key`); ValueError
    for anything else. No key may be another key followed by a slash and more: `a` and `a/b` would
    be a file and a folder of the same name. A folder rejects the second one with ValueError, a
    bucket stores both.

    `get`, `open` and `read_range` raise NotFound (`object_not_found`) for a missing key. Every
    operation raises Unavailable while a remote store can't be used: `object_store_unavailable`,
    `object_store_busy`, `object_store_refused`, `bucket_not_found`. Writing raises the subclass
    StorageFull (`object_store_full`, `disk_full`) when the store is full. Reads from a file that
    `open` returned raise the same errors.
    """

    def writer(self, key: str) -> ObjectWriter: ...

    def put(self, key: str, data: bytes) -> None: ...

    def get(self, key: str) -> bytes: ...

    def open(self, key: str) -> BinaryIO:
        """Open a seekable reader that fetches only the parts that are read."""

    def read_range(self, key: str, begin: int, size_bytes: int) -> bytes:
        """Read up to `size_bytes` from the offset `begin`; fewer only at the object's end.

        For readers that pause between two ranges for longer than a server keeps a connection open.
        """

    def file(self, key: str) -> Path | None:
        """Return the object's local file, to be read or memory-mapped but never written.

        None for a remote store.
        """

    def head(self, key: str) -> ObjectInfo | None:
        """Return the object's metadata, or None when it is missing."""

    def delete(self, key: str) -> None:
        """Delete the object; a missing one is not an error."""

    def list(self, prefix: str) -> Iterator[ObjectInfo]:
        """Iterate over the objects whose keys begin with `prefix`, in no particular order."""

    def check(self) -> None:
        """Raise Unavailable when objects can't be written now."""


class OwnedStore(ObjectStore, Protocol):
    """A store that belongs to one catalog (`shared.storage.ownership`) and has a trash.

    A *note* is a small file of the store itself. It is not an object: its name begins with
    `.placewise`, and no key does.
    """

    def move(self, source: str, target: str) -> None:
        """Rename an object; an existing one at `target` is replaced.

        `modified_at` becomes the time of the move. After a crash the object is complete at
        `source`, at `target` or at both. NotFound when `source` is missing.
        """

    def free_trash(self, min_free_bytes: int) -> int:
        """Delete objects in the trash, oldest day first, until each local disk has this much free.

        Returns the number of deleted objects; 0 for a remote store.
        """

    def read_note(self, name: str) -> bytes | None:
        """Return the note's content, or None when there is no such note."""

    def write_note(self, name: str, data: bytes, *, replace: bool = True) -> None:
        """Write the note atomically. With `replace=False` an existing note is unchanged."""

    def delete_note(self, name: str) -> None:
        """Delete the note; a missing one is not an error."""


@contextlib.contextmanager
def writing(store: ObjectStore, key: str) -> Iterator[ObjectWriter]:
    """Write an object in the block, at whose end it exists; if the block raises, it does not."""
    writer = store.writer(key)
    try:
        yield writer
        writer.commit()
    finally:
        writer.abort()


def read_up_to(file: BinaryIO, size: int) -> bytes:
    """Read `size` bytes, fewer only at the end; one read of a network stream may return less."""
    blocks = []
    while size and (block := file.read(size)):
        blocks.append(block)
        size -= len(block)
    return b"".join(blocks)
