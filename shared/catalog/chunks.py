"""Chunks and descriptors: which row of which chunk file is the descriptor of a photo.

A chunk object is immutable. Compaction writes a new chunk and supersedes the old ones. A row that
no descriptor refers to is dead; the next compaction drops it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from uuid import UUID

import sqlalchemy as sa
from sqlalchemy.orm import Mapped, Session, mapped_column

from shared.catalog.database.base import (
    Base,
    Entity,
    UtcDateTime,
    count_rows,
    db_now,
    partial_index,
)
from shared.catalog.generations import Generation, GenerationState
from shared.catalog.jobs import Job, JobState
from shared.catalog.photos import Photo, PhotoFilterValues, PhotoRole, is_geotagged, is_kept
from shared.storage.chunks import features_key

# Up to this number, rows are counted per request, which takes about 10 ms.
MAX_EXACT_COUNT = 10_000

IDS_PER_QUERY = 1000  # maximum of photo ids in one statement


class Chunk(Entity):
    """An immutable `.npy` file of `rows` descriptors, with its SHA-256.

    The columns `features_*` describe its feature file: the model of the local features (null: there
    is none), the number of rows that have some, its size and its SHA-256.
    """

    __tablename__ = "chunks"

    generation_id: Mapped[UUID] = mapped_column(
        sa.Uuid, sa.ForeignKey("generations.id"), index=True
    )
    object_key: Mapped[str] = mapped_column(sa.Text, unique=True)
    rows: Mapped[int] = mapped_column(sa.Integer)
    size_bytes: Mapped[int] = mapped_column(sa.BigInteger)
    sha256: Mapped[str] = mapped_column(sa.String(64))
    features_model: Mapped[str | None] = mapped_column(sa.String(100))
    features_rows: Mapped[int] = mapped_column(sa.Integer, default=0, server_default="0")
    features_bytes: Mapped[int] = mapped_column(sa.BigInteger, default=0, server_default="0")
    features_sha256: Mapped[str | None] = mapped_column(sa.String(64))
    # Whether compaction wrote it.
    sealed: Mapped[bool] = mapped_column(sa.Boolean, default=False)
    created_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())
    superseded_at: Mapped[datetime | None] = mapped_column(UtcDateTime)

    __table_args__ = (
        partial_index("ix_chunks_live", "generation_id", only=superseded_at.is_(None)),
        partial_index("ix_chunks_superseded", "superseded_at", only=superseded_at.is_not(None)),
    )


class Descriptor(Base):
    """The location of a photo's descriptor in a generation: chunk and row (from 0)."""

    __tablename__ = "descriptors"

    generation_id: Mapped[UUID] = mapped_column(
        sa.Uuid, sa.ForeignKey("generations.id"), primary_key=True
    )
    photo_id: Mapped[UUID] = mapped_column(sa.Uuid, sa.ForeignKey("photos.id"), primary_key=True)
    chunk_id: Mapped[UUID] = mapped_column(sa.Uuid, sa.ForeignKey("chunks.id"))
    row: Mapped[int] = mapped_column(sa.Integer)

    __table_args__ = (
        sa.Index("uq_descriptors_chunk_row", "chunk_id", "row", unique=True),
        sa.Index("ix_descriptors_photo", "photo_id"),
    )


def find_descriptor(
    session: Session, generation_id: UUID, photo_id: UUID
) -> tuple[Descriptor, Chunk] | None:
    """Return the photo's descriptor in the generation and its chunk; None if there is none."""
    row = session.execute(
        sa.select(Descriptor, Chunk)
        .join(Chunk, Chunk.id == Descriptor.chunk_id)
        .where(Descriptor.generation_id == generation_id, Descriptor.photo_id == photo_id)
    ).one_or_none()
    return None if row is None else (row[0], row[1])


def find_descriptor_rows(
    session: Session,
    generation_id: UUID,
    photo_ids: Sequence[UUID],
    *,
    features_model: str | None = None,
) -> dict[str, list[tuple[int, UUID]]]:
    """Locate the descriptors of photos in the generation; photos without one are left out.

    With `features_model`, those in chunks without local features of that model are left out, too.

    Returns:
        Object key of a chunk -> (row, photo id) of its descriptors, sorted by row.
    """
    rows_by_key: dict[str, list[tuple[int, UUID]]] = {}
    has_features = sa.true() if features_model is None else Chunk.features_model == features_model
    for begin in range(0, len(photo_ids), IDS_PER_QUERY):
        located = session.execute(
            sa.select(Chunk.object_key, Descriptor.row, Descriptor.photo_id)
            .join(Chunk, Chunk.id == Descriptor.chunk_id)
            .where(
                Descriptor.generation_id == generation_id,
                Descriptor.photo_id.in_(photo_ids[begin : begin + IDS_PER_QUERY]),
                has_features,
            )
        )
        for object_key, row, photo_id in located:
            rows_by_key.setdefault(object_key, []).append((row, photo_id))
    for rows in rows_by_key.values():
        rows.sort()
    return rows_by_key


def find_features_model(session: Session, generation_id: UUID) -> str | None:
    """Return the model of the generation's newest local features; None if it has none."""
    return session.scalar(
        sa.select(Chunk.features_model)
        .where(
            Chunk.generation_id == generation_id,
            Chunk.superseded_at.is_(None),
            Chunk.features_model.is_not(None),
        )
        .order_by(Chunk.id.desc())
        .limit(1)
    )


@dataclass(frozen=True, slots=True)
class FeatureCounts:
    """Local features of a generation's live chunks; rows of deleted photos may be among them."""

    photos: int
    size_bytes: int
    missing: int
    """rows without features"""


def count_features(session: Session, generation_id: UUID) -> FeatureCounts:
    """Count the local features of the generation."""
    columns = (
        Chunk.features_rows,
        Chunk.features_bytes,
        Chunk.rows - Chunk.features_rows,
    )
    sums = [sa.func.coalesce(sa.func.sum(column), 0) for column in columns]
    live = (Chunk.generation_id == generation_id) & Chunk.superseded_at.is_(None)
    return FeatureCounts(*map(int, session.execute(sa.select(*sums).where(live)).one()))


def find_feature_rows(
    session: Session, generation_id: UUID, photo_ids: Sequence[UUID]
) -> dict[UUID, tuple[str, int]]:
    """Return key and row of the feature file of each of the photos whose chunk has one."""
    located = session.execute(
        sa.select(Descriptor.photo_id, Chunk.object_key, Descriptor.row)
        .join(Chunk, Chunk.id == Descriptor.chunk_id)
        .where(
            Descriptor.generation_id == generation_id,
            Descriptor.photo_id.in_(photo_ids),
            Chunk.features_model.is_not(None),
        )
    )
    return {photo_id: (features_key(object_key), row) for photo_id, object_key, row in located}


def list_live_chunks(session: Session, generation_id: UUID) -> list[Chunk]:
    """List the chunks of the generation that are not superseded, oldest first."""
    return list(
        session.scalars(
            sa.select(Chunk)
            .where(Chunk.generation_id == generation_id, Chunk.superseded_at.is_(None))
            .order_by(Chunk.id)
        )
    )


def list_live_rows(session: Session, chunk_id: UUID) -> list[tuple[int, UUID]]:
    """List (row, photo id) of the chunk's rows of live photos and of those in the trash, by row."""
    return [(row, values.photo_id) for row, values in list_live_filter_values(session, chunk_id)]


def delete_chunk_rows(session: Session, chunk_id: UUID) -> None:
    """Delete the chunk's row and its descriptors, of which there are up to CHUNK_ROWS."""
    session.execute(sa.delete(Descriptor).where(Descriptor.chunk_id == chunk_id))
    session.execute(sa.delete(Chunk).where(Chunk.id == chunk_id))


def list_live_filter_values(
    session: Session, chunk_id: UUID
) -> list[tuple[int, PhotoFilterValues]]:
    """List (row, filter values of its photo) of the chunk's live rows, by row.

    Also of those of photos in the trash, which no search returns until they are restored.
    """
    rows = session.execute(
        sa.select(Descriptor.row, *PhotoFilterValues.COLUMNS)
        .join(Photo, Photo.id == Descriptor.photo_id)
        .where(Descriptor.chunk_id == chunk_id, is_kept())
        .order_by(Descriptor.row)
    )
    return [(row[0], PhotoFilterValues(*row[1:])) for row in rows]


def estimate_described(session: Session, generation_id: UUID) -> int:
    """Count the live photos with a descriptor in the generation, or estimate, for progress.

    Above MAX_EXACT_COUNT it is the sum of the chunks' rows, which may include rows of photos that
    were deleted since the last compaction.
    """
    rows = session.scalar(
        sa.select(sa.func.sum(Chunk.rows)).where(
            Chunk.generation_id == generation_id, Chunk.superseded_at.is_(None)
        )
    )
    if rows and rows > MAX_EXACT_COUNT:
        return int(rows)
    return count_described(session, generation_id)


def list_described(session: Session, generation_id: UUID) -> set[UUID]:
    """Return the live photos with a descriptor in the generation."""
    return set(session.scalars(_select_described(generation_id)))


def count_described(session: Session, generation_id: UUID) -> int:
    """Count the live photos with a descriptor in the generation."""
    return count_rows(session, _select_described(generation_id))


def count_searchable(session: Session, generation_id: UUID) -> int:
    """Count the photos that searches of the generation can return."""
    return count_rows(session, _select_described(generation_id, PhotoRole.DATABASE))


def select_failed_photos(map_id: UUID) -> sa.Select[UUID]:
    """Select the map's live photos that can't be searched for, because their description failed."""
    described = sa.exists().where(
        Descriptor.photo_id == Photo.id,
        Descriptor.generation_id == Generation.id,
        Generation.state == GenerationState.ACTIVE,
    )
    return (
        sa.select(Photo.id)
        .join(Job, Photo.id == Job.photo_id)
        .where(
            Job.map_id == map_id,
            Job.state == JobState.FAILED,
            Job.id == Photo.job_id,
            Photo.deleted_at.is_(None),
            ~described,
        )
    )


def count_geotagged(session: Session, generation_id: UUID, role: PhotoRole) -> int:
    """Count the live geotagged photos of a role with a descriptor in the generation."""
    return count_rows(session, _select_described(generation_id, role).where(is_geotagged()))


def has_geotagged(session: Session, generation_id: UUID, role: PhotoRole) -> bool:
    """Return whether `count_geotagged` is not 0."""
    geotagged = _select_described(generation_id, role).where(is_geotagged())
    return session.scalar(geotagged.limit(1)) is not None


def _select_described(generation_id: UUID, role: PhotoRole | None = None) -> sa.Select[UUID]:
    statement = (
        sa.select(Descriptor.photo_id)
        .join(Photo, Photo.id == Descriptor.photo_id)
        .where(Descriptor.generation_id == generation_id, Photo.deleted_at.is_(None))
    )
    return statement if role is None else statement.where(Photo.role == role)
