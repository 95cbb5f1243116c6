"""What a look at the whole store has found."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from enum import StrEnum
from uuid import UUID


class FaultKind(StrEnum):
    MISSING = "missing"  # the catalog names an object that is not there
    DAMAGED = "damaged"  # its bytes are not those that were written
    DIFFERENT = "different"  # the catalog says something else of it than it does itself
    NOT_DESCRIBED = "not_described"  # the job succeeded, and no descriptor is there


@dataclass(frozen=True, slots=True)
class IntegrityFault:
    wrong: FaultKind
    what: str
    """`original`, `chunk`, `manifest`, ..., or `photo`."""
    name: str
    """The object's key, or the photo's id."""
    detail: str
    chunk_id: UUID | None = None
    """The chunk that it makes useless."""
    photo_id: UUID | None = None
    """The photo that has to be described again."""


@dataclass(slots=True)
class IntegrityReport:
    checked: Counter[str] = field(default_factory=Counter)
    """By what they are."""
    read_bytes: int = 0
    faults: list[IntegrityFault] = field(default_factory=list)
    orphans: int = 0
    """Objects that no row knows. The steward moves them to the trash when they are old enough."""
    orphan_bytes: int = 0
    trash_objects: int = 0
    trash_bytes: int = 0
