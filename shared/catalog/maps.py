"""Maps: named databases of photos, each with its own extractor, active generation and version.

A deleted map keeps its row, under a name that no one can ask for, until the steward has removed
everything that belongs to it.
"""

from __future__ import annotations

from datetime import datetime
from uuid import UUID

from sqlalchemy import BigInteger, String, Uuid, select, update
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Mapped, Session, mapped_column

from shared.catalog.base import Base, UtcDateTime, db_now
from shared.catalog.journaled import Journaled
from shared.errors import Conflict, NotFound
from shared.ids import new_id

DEFAULT_MAP = "default"
MAP_NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$"
DELETED_NAME_PREFIX = "deleted/"  # no name that people can give holds a slash


class Map(Journaled, Base):
    """`version` grows with every transaction that changes what can be found in the map."""

    __tablename__ = "maps"

    id: Mapped[UUID] = mapped_column(Uuid, primary_key=True, default=new_id)
    name: Mapped[str] = mapped_column(String(100), unique=True)
    extractor: Mapped[str] = mapped_column(String(200))
    version: Mapped[int] = mapped_column(BigInteger, default=0)
    created_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())
    deleted_at: Mapped[datetime | None] = mapped_column(UtcDateTime)


def create_map(session: Session, name: str, extractor: str) -> Map:
    """A new, empty map; 409 (`map_exists`) when the name is taken."""
    made = Map(id=new_id(), name=name, extractor=extractor)
    try:
        with session.begin_nested():
            session.add(made)
            session.flush()
    except IntegrityError:
        raise Conflict("map_exists", f"There is a map named {name!r} already.", map=name) from None
    return made


def list_maps(session: Session) -> list[Map]:
    """Every live map, by name."""
    return list(session.scalars(select(Map).where(Map.deleted_at.is_(None)).order_by(Map.name)))


def mark_map_deleted(session: Session, map_: Map) -> None:
    """The map is gone from every answer from this commit on, and its name is free.

    What belongs to it goes later: `services.steward.delete_maps`.
    """
    map_.name = f"{DELETED_NAME_PREFIX}{map_.id}"
    map_.deleted_at = db_now()
    session.flush()


def get_or_create_default_map(session: Session, extractor: str) -> Map:
    """The map named `default`, made on first use."""
    found = session.scalar(select(Map).where(Map.name == DEFAULT_MAP))
    if found is not None:
        return found
    try:
        return create_map(session, DEFAULT_MAP, extractor)
    except Conflict:  # another process made it between the two statements
        return get_map(session, DEFAULT_MAP)


def get_map(session: Session, name: str) -> Map:
    """The map called `name`; 404 when there is none."""
    found = session.scalar(select(Map).where(Map.name == name, Map.deleted_at.is_(None)))
    if found is None:
        raise NotFound(
            "map_not_found",
            f"There is no map named {name!r}. Make it: POST /api/v1/maps, or "
            f"`placewise maps create {name}`.",
            map=name,
        )
    return found


def lock_map(session: Session, map_id: UUID) -> Map:
    """The map's row as it is now, locked until the transaction ends.

    Publishing, activation and deletion take this lock, so what they read of the map stays true
    until they commit. SQLite has one writer and needs no row lock.
    """
    return session.scalars(
        select(Map)
        .where(Map.id == map_id)
        .with_for_update()
        .execution_options(populate_existing=True)
    ).one()


def increment_map_version(session: Session, map_id: UUID) -> int:
    """One more: search workers following the map will look again. Returns the new version.

    The row stays locked until commit, so versions become visible in the order of their numbers.
    """
    return session.execute(
        update(Map).where(Map.id == map_id).values(version=Map.version + 1).returning(Map.version)
    ).scalar_one()
