"""A chunk as a search worker has it: rows, what is known of their photos, and codes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING
from uuid import UUID

from services.search.local_files import MappedFile
from services.search.photo_columns import PhotoColumns
from shared.chunks import Rows

if TYPE_CHECKING:  # numba takes a while to load, and small maps need no codes
    from shared.codes.int8 import Int8Codes
    from shared.codes.signs import SignCodes


@dataclass(frozen=True, slots=True, eq=False)
class LoadedChunk:
    """A chunk's rows, (n, dimension) float32, and what is known of their photos."""

    chunk_id: UUID
    object_key: str
    rows: Rows
    photos: PhotoColumns
    codes: SignCodes | None = None
    """None while search does without."""
    stored: StoredChunk | None = None
    """Where rows and codes lie on the disk; None for rows that were never there."""
    int8: Int8Codes | None = None
    """None while search does without."""

    def was_changed(self) -> bool:
        """Whether its file was damaged since it was mapped (`Mapped.was_changed`)."""
        return self.stored is not None and self.stored.file.was_changed()

    def prefetch_row(self, row: int) -> None:
        """Say that a row is read next, where it is mapped from a file."""
        if self.stored is not None and self.rows is self.stored.rows:
            size_bytes = self.rows.strides[0]
            begin = self.stored.file.size_bytes - self.rows.nbytes  # a header goes before
            self.stored.file.prefetch(begin + row * size_bytes, size_bytes)


@dataclass(frozen=True, slots=True, eq=False)
class StoredChunk:
    """A chunk's files, mapped into memory."""

    file: MappedFile
    rows: Rows
    sha256: str
    codes: SignCodes | None = None
    int8: Int8Codes | None = None
