"""Chunks and descriptor rows: which photo's descriptor is which row of which file.

A chunk object is never rewritten. Merging writes a new one in the same slot and supersedes the
old; a row that no descriptor points at is dead and is dropped at the next merging.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from uuid import UUID

from sqlalchemy import (
    BigInteger,
    Boolean,
    ForeignKey,
    Index,
    Integer,
    Select,
    String,
    Text,
    Uuid,
    func,
    select,
)
from sqlalchemy.orm import Mapped, Session, mapped_column

from shared.catalog.base import Base, UtcDateTime, db_now
from shared.catalog.generations import Generation
from shared.catalog.photos import Photo, PhotoFilterValues, PhotoRole, is_geotagged
from shared.ids import new_id

# Rows that are counted whenever someone asks: some 10 ms.
MAX_EXACT_COUNT = 10_000

IDS_PER_QUERY = 1000  # photos named in one statement


class Chunk(Base):
    """One immutable `.npy` file of `rows` descriptors, float32, with its hash."""

    __tablename__ = "chunks"

    id: Mapped[UUID] = mapped_column(Uuid, primary_key=True, default=new_id)
    generation_id: Mapped[UUID] = mapped_column(Uuid, ForeignKey("generations.id"), index=True)
    slot: Mapped[int] = mapped_column(Integer)
    object_key: Mapped[str] = mapped_column(Text, unique=True)
    rows: Mapped[int] = mapped_column(Integer)
    size_bytes: Mapped[int] = mapped_column(BigInteger)
    sha256: Mapped[str] = mapped_column(String(64))
    sealed: Mapped[bool] = mapped_column(Boolean, default=False)
    created_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())
    superseded_at: Mapped[datetime | None] = mapped_column(UtcDateTime)

    __table_args__ = (
        Index(
            "ix_chunks_live",
            "generation_id",
            "slot",
            postgresql_where=superseded_at.is_(None),
            sqlite_where=superseded_at.is_(None),
        ),
        Index(
            "ix_chunks_superseded",
            "superseded_at",
            postgresql_where=superseded_at.is_not(None),
            sqlite_where=superseded_at.is_not(None),
        ),
    )


class Descriptor(Base):
    """Where the one descriptor of a photo in a generation lies: chunk and row (from 0)."""

    __tablename__ = "descriptors"

    generation_id: Mapped[UUID] = mapped_column(
        Uuid, ForeignKey("generations.id"), primary_key=True
    )
    photo_id: Mapped[UUID] = mapped_column(Uuid, ForeignKey("photos.id"), primary_key=True)
    chunk_id: Mapped[UUID] = mapped_column(Uuid, ForeignKey("chunks.id"))
    row: Mapped[int] = mapped_column(Integer)

    __table_args__ = (
        Index("uq_descriptors_chunk_row", "chunk_id", "row", unique=True),
        Index("ix_descriptors_photo", "photo_id"),
    )


def find_descriptor(
    session: Session, generation_id: UUID, photo_id: UUID
) -> tuple[Descriptor, Chunk] | None:
    """The photo's descriptor in the generation and the chunk that holds it."""
    found = session.execute(
        select(Descriptor, Chunk)
        .join(Chunk, Chunk.id == Descriptor.chunk_id)
        .where(Descriptor.generation_id == generation_id, Descriptor.photo_id == photo_id)
    ).one_or_none()
    return None if found is None else (found[0], found[1])


def find_descriptor_rows(
    session: Session, generation_id: UUID, photo_ids: Sequence[UUID]
) -> dict[str, list[tuple[int, UUID]]]:
    """Where the photos' descriptors in the generation lie: (row, photo) by row, of each chunk's
    object; photos without one are left out."""
    found: dict[str, list[tuple[int, UUID]]] = {}
    for begin in range(0, len(photo_ids), IDS_PER_QUERY):
        located = session.execute(
            select(Chunk.object_key, Descriptor.row, Descriptor.photo_id)
            .join(Chunk, Chunk.id == Descriptor.chunk_id)
            .where(
                Descriptor.generation_id == generation_id,
                Descriptor.photo_id.in_(photo_ids[begin : begin + IDS_PER_QUERY]),
            )
        )
        for object_key, row, photo_id in located:
            found.setdefault(object_key, []).append((row, photo_id))
    for rows in found.values():
        rows.sort()
    return found


def list_live_chunks(session: Session, generation_id: UUID) -> list[Chunk]:
    """The chunks that make up the generation now, in slot order."""
    return list(
        session.scalars(
            select(Chunk)
            .where(Chunk.generation_id == generation_id, Chunk.superseded_at.is_(None))
            .order_by(Chunk.slot, Chunk.id)
        )
    )


def list_live_rows(session: Session, chunk_id: UUID) -> list[tuple[int, UUID]]:
    """(row, photo) of the chunk's rows that belong to live photos, by row."""
    return [(row, facts.photo_id) for row, facts in list_live_filter_values(session, chunk_id)]


def list_live_filter_values(
    session: Session, chunk_id: UUID
) -> list[tuple[int, PhotoFilterValues]]:
    """(row, what search knows of its photo) of the chunk's live rows, by row."""
    found = session.execute(
        select(Descriptor.row, *PhotoFilterValues.COLUMNS)
        .join(Photo, Photo.id == Descriptor.photo_id)
        .where(Descriptor.chunk_id == chunk_id, Photo.deleted_at.is_(None))
        .order_by(Descriptor.row)
    )
    return [(row[0], PhotoFilterValues(*row[1:])) for row in found]


def count_described(session: Session, generation_id: UUID, role: PhotoRole | None = None) -> int:
    """How many live photos, of one role or of any, have a descriptor in the generation."""
    counted = (
        select(func.count())
        .select_from(Descriptor)
        .join(Photo, Photo.id == Descriptor.photo_id)
        .where(Descriptor.generation_id == generation_id, Photo.deleted_at.is_(None))
    )
    if role is not None:
        counted = counted.where(Photo.role == role)
    return session.scalar(counted) or 0


def estimate_described(session: Session, generation_id: UUID) -> int:
    """As `count_described`, for progress: beyond COUNTED_NOW the chunks' rows are added up, which
    may hold some of photos that were deleted since they were merged last."""
    rows = session.scalar(
        select(func.sum(Chunk.rows)).where(
            Chunk.generation_id == generation_id, Chunk.superseded_at.is_(None)
        )
    )
    return int(rows) if rows and rows > MAX_EXACT_COUNT else count_described(session, generation_id)


def count_searchable(session: Session, generation_id: UUID) -> int:
    """How many photos can be found in the generation."""
    return count_described(session, generation_id, PhotoRole.DATABASE)


def count_geotagged(session: Session, generation_id: UUID, role: PhotoRole) -> int:
    """How many live photos of a role have a descriptor in the generation and a known place."""
    located = _select_geotagged(generation_id, role).subquery()
    return session.scalar(select(func.count()).select_from(located)) or 0


def has_geotagged(session: Session, generation_id: UUID, role: PhotoRole) -> bool:
    """Whether there is one of those that `count_geotagged` counts."""
    return session.scalar(_select_geotagged(generation_id, role).limit(1)) is not None


def _select_geotagged(generation_id: UUID, role: PhotoRole) -> Select[UUID]:
    return (
        select(Descriptor.photo_id)
        .join(Photo, Photo.id == Descriptor.photo_id)
        .where(
            Descriptor.generation_id == generation_id,
            Photo.deleted_at.is_(None),
            Photo.role == role,
            is_geotagged(),
        )
    )


def allocate_slot(generation: Generation, rows: int, slot_rows: int) -> int:
    """The slot that a new chunk of `rows` goes into, holding at most `slot_rows` in the end.

    The caller holds the generation's lock.
    """
    if generation.open_slot_rows and generation.open_slot_rows + rows > slot_rows:
        generation.open_slot += 1
        generation.open_slot_rows = 0
    generation.open_slot_rows += rows
    return generation.open_slot
