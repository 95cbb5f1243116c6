"""The object store of a duty that throws things away, with its deletions counted."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

from shared.objects import ObjectStore
from shared.objects.port import ObjectInfo, ObjectWriter


class DeletionCountingStore:
    """`store`, and `on_delete` after each deletion."""

    def __init__(self, store: ObjectStore, on_delete: Callable[[], object]) -> None:
        self._store = store
        self._on_delete = on_delete

    def delete(self, key: str) -> None:
        self._store.delete(key)
        self._on_delete()

    def writer(self, key: str) -> ObjectWriter:
        return self._store.writer(key)

    def put(self, key: str, data: bytes) -> None:
        self._store.put(key, data)

    def get(self, key: str) -> bytes:
        return self._store.get(key)

    def open(self, key: str) -> BinaryIO:
        return self._store.open(key)

    def read_range(self, key: str, begin: int, size_bytes: int) -> bytes:
        return self._store.read_range(key, begin, size_bytes)

    def file(self, key: str) -> Path | None:
        return self._store.file(key)

    def head(self, key: str) -> ObjectInfo | None:
        return self._store.head(key)

    def list(self, prefix: str) -> Iterator[ObjectInfo]:
        return self._store.list(prefix)

    def check(self) -> None:
        self._store.check()
