"""Photos of maps."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime
from typing import Any, ClassVar
from uuid import UUID

import sqlalchemy as sa
from sqlalchemy.orm import Mapped, Session, mapped_column

from shared.catalog.database.base import (
    Condition,
    CoordinateColumn,
    Entity,
    Journaled,
    JsonValue,
    UtcDateTime,
    count_rows,
    db_now,
    db_now_plus,
    filename_trigrams,
    json_array_has_part,
    partial_index,
)
from shared.enums import PhotoRole as PhotoRole
from shared.errors import NotFound
from shared.search_api.photo_filter import is_part_of_tag


class Photo(Journaled, Entity):
    """A live or deleted photo. `sha256` is unique among the live photos of a map.

    So is `picture_sha256`, the hash of its path and of the file without metadata; null if unknown.

    `job_id` is the job that describes the photo; the photo is searchable if it has a row in
    `descriptors`. `altitude` is in metres, above the sea where its source says so; `focal_length`
    is a multiple of the longer side. `changed_version` is the map's version at the last change that
    affects searches. `given_place` is the journal of a place that the photo was given here: the
    `former` and the `written` values by column, `probability`, `reason` and `given_at`; or of one
    that was `denied`.
    """

    __tablename__ = "photos"

    map_id: Mapped[UUID] = mapped_column(sa.Uuid, sa.ForeignKey("maps.id"))
    job_id: Mapped[UUID | None] = mapped_column(sa.Uuid)
    role: Mapped[PhotoRole] = mapped_column(
        sa.String(10), default=PhotoRole.DATABASE, server_default=PhotoRole.DATABASE
    )
    sha256: Mapped[str] = mapped_column(sa.String(64))
    picture_sha256: Mapped[str | None] = mapped_column(sa.String(64))
    object_key: Mapped[str] = mapped_column(sa.Text)
    filename: Mapped[str] = mapped_column(sa.Text)
    relative_path: Mapped[str | None] = mapped_column(sa.Text)  # in its folder or archive
    media_type: Mapped[str] = mapped_column(sa.String(50))
    size_bytes: Mapped[int] = mapped_column(sa.BigInteger)
    width: Mapped[int] = mapped_column(sa.Integer)
    height: Mapped[int] = mapped_column(sa.Integer)
    latitude: Mapped[float | None] = mapped_column(CoordinateColumn)
    longitude: Mapped[float | None] = mapped_column(CoordinateColumn)
    altitude: Mapped[float | None] = mapped_column(sa.Float)
    heading: Mapped[float | None] = mapped_column(sa.Float)
    focal_length: Mapped[float | None] = mapped_column(sa.Float)
    captured_at: Mapped[datetime | None] = mapped_column(UtcDateTime)
    capture: Mapped[dict[str, Any] | None] = mapped_column(JsonValue)  # of `describe_capture`
    place: Mapped[str | None] = mapped_column(sa.Text)
    tags: Mapped[list[str]] = mapped_column(JsonValue, default=list)
    attributes: Mapped[dict[str, Any]] = mapped_column("metadata", JsonValue, default=dict)
    given_place: Mapped[dict[str, Any] | None] = mapped_column(JsonValue)
    uploaded_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())
    deleted_at: Mapped[datetime | None] = mapped_column(UtcDateTime)
    purge_at: Mapped[datetime | None] = mapped_column(UtcDateTime)  # deleted: its objects go then
    changed_version: Mapped[int] = mapped_column(sa.BigInteger, default=0)
    key_id: Mapped[UUID | None] = mapped_column(sa.Uuid)  # the API key of the upload, if any

    __table_args__ = (
        sa.CheckConstraint(
            "(latitude IS NULL) = (longitude IS NULL)", name="coordinates_come_in_pairs"
        ),
        partial_index(
            "uq_photos_live_sha256", "map_id", "sha256", only=deleted_at.is_(None), unique=True
        ),
        partial_index(
            "uq_photos_live_picture",
            "map_id",
            "picture_sha256",
            only=deleted_at.is_(None),
            unique=True,
        ),
        sa.Index("ix_photos_map_uploaded", "map_id", "uploaded_at", "id"),
        sa.Index("ix_photos_map_changed", "map_id", "changed_version"),
        sa.Index("ix_photos_map_position", "map_id", "latitude", "longitude"),
        sa.Index("ix_photos_object_key", "object_key"),
        partial_index(
            "ix_photos_not_journaled",
            "id",
            only=sa.column("revision") != sa.column("journaled_revision"),
        ),
        partial_index(
            "ix_photos_key", "key_id", only=sa.and_(deleted_at.is_(None), key_id.is_not(None))
        ),
        partial_index("ix_photos_map_size", "map_id", "size_bytes", only=deleted_at.is_(None)),
        partial_index(
            "ix_photos_map_captured",
            "map_id",
            "captured_at",
            only=sa.and_(deleted_at.is_(None), captured_at.is_not(None)),
        ),
        partial_index(
            "ix_photos_map_place",
            "map_id",
            "place",
            only=sa.and_(deleted_at.is_(None), place.is_not(None)),
        ),
        partial_index(
            "ix_photos_map_labelled",
            "map_id",
            "id",
            only=sa.and_(deleted_at.is_(None), role == PhotoRole.QUERY),
        ),
        # Over all maps: a GIN index on an array can't have the map as its first column.
        sa.Index(
            "ix_photos_tags",
            "tags",
            postgresql_using="gin",
            postgresql_ops={"tags": "jsonb_path_ops"},
            postgresql_where=deleted_at.is_(None),
        ).ddl_if(dialect="postgresql"),
        sa.Index(
            "ix_photos_filename",
            filename_trigrams(filename),
            postgresql_using="gin",
            postgresql_where=deleted_at.is_(None),
        ).ddl_if(dialect="postgresql"),
        sa.Index(
            "ix_photos_relative_path",
            filename_trigrams(relative_path),
            postgresql_using="gin",
            postgresql_where=deleted_at.is_(None),
        ).ddl_if(dialect="postgresql"),
        partial_index("ix_photos_deleted", "deleted_at", only=deleted_at.is_not(None)),
    )

    @property
    def place_is_as_given(self) -> bool:
        """Whether the photo has the place that it was given, and not another one since."""
        written = self.given_place["written"] if self.given_place else {}
        return all(getattr(self, name) == value for name, value in written.items())


@dataclass(frozen=True, slots=True)
class PhotoFilterValues:
    """The columns of a photo that search workers hold in memory for filters."""

    COLUMNS: ClassVar = (
        Photo.id,
        Photo.role,
        Photo.deleted_at,
        Photo.latitude,
        Photo.longitude,
        Photo.captured_at,
        Photo.place,
        Photo.tags,
    )

    photo_id: UUID
    role: PhotoRole
    deleted_at: datetime | None
    latitude: float | None
    longitude: float | None
    captured_at: datetime | None
    place: str | None
    tags: list[str]

    @property
    def findable(self) -> bool:
        """Whether the photo is live and not a labelled query."""
        return self.deleted_at is None and self.role == PhotoRole.DATABASE


def get_photo(session: Session, map_id: UUID, photo_id: UUID, *, or_removed: bool = False) -> Photo:
    """Return a live photo of the map, or also one in the trash; NotFound (`photo_not_found`)."""
    is_there = is_kept() if or_removed else Photo.deleted_at.is_(None)
    photo = session.scalar(
        sa.select(Photo).where(Photo.id == photo_id, Photo.map_id == map_id, is_there)
    )
    if photo is None:
        raise NotFound(
            "photo_not_found", f"There is no photo {photo_id} in this map.", file_id=str(photo_id)
        )
    return photo


def find_same_photo(
    session: Session, map_id: UUID, sha256: str, picture_sha256: str | None
) -> Photo | None:
    """Return the live photo with these bytes, or else with this path and picture, if any."""
    for same in (Photo.sha256 == sha256, Photo.picture_sha256 == picture_sha256):
        photo = session.scalar(
            sa.select(Photo).where(Photo.map_id == map_id, same, Photo.deleted_at.is_(None))
        )
        if photo is not None or picture_sha256 is None:
            return photo
    return None


def get_live_photos(session: Session, photo_ids: Iterable[UUID]) -> dict[UUID, Photo]:
    """Return the live photos among the ids, by id."""
    photos = session.scalars(
        sa.select(Photo).where(Photo.id.in_(list(photo_ids)), Photo.deleted_at.is_(None))
    )
    return {photo.id: photo for photo in photos}


def list_photos_changed_since(
    session: Session, map_id: UUID, version: int
) -> list[PhotoFilterValues]:
    """Return the current values of the photos that were changed or deleted after `version`."""
    rows = session.execute(
        sa.select(*PhotoFilterValues.COLUMNS).where(
            Photo.map_id == map_id, Photo.changed_version > version
        )
    )
    return [PhotoFilterValues(*row) for row in rows]


def list_tags_with(session: Session, map_id: UUID, part: str) -> list[str]:
    """List the tags of the map's live photos of which `part` is a part, in either case."""
    lists = session.scalars(
        sa.select(Photo.tags)
        .where(Photo.map_id == map_id, Photo.deleted_at.is_(None))
        .where(json_array_has_part(Photo.tags, part))
        .distinct()
    )
    return sorted({tag for tags in lists for tag in tags if is_part_of_tag(part, tag)})


def select_live_photos(map_id: UUID, role: PhotoRole | None = None) -> sa.Select[UUID]:
    """Select the live photos of the map, of one role or of all."""
    statement = sa.select(Photo.id).where(Photo.map_id == map_id, Photo.deleted_at.is_(None))
    return statement if role is None else statement.where(Photo.role == role)


def count_live_photos(session: Session, map_id: UUID, role: PhotoRole | None = None) -> int:
    """Count the live photos of the map, of one role or of all."""
    return count_rows(session, select_live_photos(map_id, role))


def has_live_photo(session: Session, map_id: UUID, role: PhotoRole) -> bool:
    """Return whether the map has a live photo of the role."""
    return session.scalar(select_live_photos(map_id, role).limit(1)) is not None


def has_given_place(photo: type[Photo] = Photo) -> Condition:
    """Condition for photos whose place was given here, not sent with them."""
    return photo.given_place.is_not(None)


def is_geotagged(photo: type[Photo] = Photo) -> Condition:
    """Condition for photos with coordinates or a place label."""
    return sa.or_(photo.latitude.is_not(None), photo.place.is_not(None))


def is_removed() -> Condition:
    """Condition for deleted photos whose objects are kept for now: the trash."""
    return sa.and_(Photo.deleted_at.is_not(None), Photo.purge_at > db_now())


def is_kept() -> Condition:
    """Condition for live photos and those in the trash."""
    return sa.or_(Photo.deleted_at.is_(None), is_removed())


def mark_photo_deleted(
    session: Session, photo: Photo, version: int, kept_days: float = 0.0
) -> None:
    """Hide the photo from all responses from this commit on; its objects are deleted later.

    Args:
        kept_days: How long the photo stays in the trash.
    """
    session.execute(
        sa.update(Photo)
        .where(Photo.id == photo.id)
        .values(
            deleted_at=db_now(), purge_at=db_now_plus(kept_days * 86_400), changed_version=version
        )
    )
