"""What every object store can do. One contract test serves all of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import BinaryIO, Protocol


@dataclass(frozen=True, slots=True)
class ObjectInfo:
    key: str
    size_bytes: int
    modified_at: datetime
    """When it was written, by the store's clock, UTC."""


@dataclass(frozen=True, slots=True)
class PresignedPut:
    """An address at which one object may be put, without keys."""

    url: str
    headers: dict[str, str]
    """To be sent with it, as they stand: they are part of the signature."""


class ObjectWriter(Protocol):
    """Writes one object piece by piece; nothing is visible before `commit`."""

    def write(self, data: bytes) -> None: ...

    def commit(self) -> None:
        """Make the whole object visible and durable at once.

        When it raises Unavailable, the object is whole or absent, and no one knows which.
        """

    def abort(self) -> None:
        """Forget what was written; harmless after `commit`. Raises nothing."""


class ObjectStore(Protocol):
    """Objects are whole or absent: a crash never leaves a part of one under its key.

    A key is names joined by single slashes (`shared.storage.keys.check_key`); ValueError for
    anything else. No key may continue another one's after a slash: `a` and `a/b` are a file and a
    folder of one name. A folder refuses the second one with ValueError, a bucket keeps both.

    `get`, `open` and `read_range` raise NotFound (`object_not_found`) for a missing key. Everything
    raises Unavailable while a store on another machine can't be used: `object_store_unavailable`,
    `object_store_busy`, `object_store_refused`, `bucket_not_found`; writing raises its kind
    StorageFull (`object_store_full`, `disk_full`) when there is no room. Reading from what `open`
    has given raises so, too.
    """

    def writer(self, key: str) -> ObjectWriter: ...

    def put(self, key: str, data: bytes) -> None: ...

    def get(self, key: str) -> bytes: ...

    def open(self, key: str) -> BinaryIO:
        """A seekable reader that fetches only what is read."""

    def read_range(self, key: str, begin: int, size_bytes: int) -> bytes:
        """Up to `size_bytes` from the offset `begin`, fewer only where the object ends before; for
        readers that rest between two ranges longer than a server keeps a connection."""

    def file(self, key: str) -> Path | None:
        """The file that an object is, where objects are files of this machine: it may be read and
        mapped, never written. None elsewhere."""

    def head(self, key: str) -> ObjectInfo | None: ...

    def delete(self, key: str) -> None:
        """Remove the object; a missing one is not an error."""

    def list(self, prefix: str) -> Iterator[ObjectInfo]:
        """Every object whose key begins with `prefix`, in no particular order."""

    def check(self) -> None:
        """Raise Unavailable when objects can't be written now."""


class OwnedStore(ObjectStore, Protocol):
    """A store that belongs to one catalog (`shared.storage.ownership`) and has a trash.

    A *note* is a small file of the store itself, beside the objects and no object: its name begins
    with `.placewise`, which no key may do.
    """

    def move(self, source: str, target: str) -> None:
        """Give the object another key. `modified_at` becomes the time of the move; an object at
        `target` is replaced. After a crash it is at `source`, at `target`, or whole at both.
        NotFound where there is no `source`."""

    def free_trash(self, least_free_bytes: int) -> int:
        """Delete objects of the trash, oldest day first, until each local disk that has some of it
        has this much free; how many. 0 for a store on another machine."""

    def read_note(self, name: str) -> bytes | None:
        """None where there is no note of this name."""

    def write_note(self, name: str, data: bytes, *, replace: bool = True) -> None:
        """Write the note whole. With `replace=False` one that is there already stays."""

    def delete_note(self, name: str) -> None:
        """Remove the note; a missing one is not an error."""


class PresigningStore(OwnedStore, Protocol):
    """A store that callers may send objects to themselves: a bucket."""

    def presign_put(
        self, key: str, *, size_bytes: int, sha256: str, expires_seconds: int
    ) -> PresignedPut:
        """An address for an object of this size and SHA-256 (hexadecimal), good for so long."""

    def copy(self, source: str, target: str) -> None:
        """`target` is what `source` is now, and stays so. NotFound where there is no `source`."""
