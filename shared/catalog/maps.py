"""Maps: named databases of photos, each with its own active generation and version."""

from __future__ import annotations

from datetime import datetime
from uuid import UUID

from sqlalchemy import BigInteger, String, Uuid, select, update
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Mapped, Session, mapped_column

from shared.catalog.base import Base, UtcDateTime, db_now
from shared.errors import NotFound
from shared.ids import new_id

DEFAULT_MAP = "default"


class Map(Base):
    """`version` grows with every transaction that changes what can be found in the map."""

    __tablename__ = "maps"

    id: Mapped[UUID] = mapped_column(Uuid, primary_key=True, default=new_id)
    name: Mapped[str] = mapped_column(String(100), unique=True)
    extractor: Mapped[str] = mapped_column(String(200))
    version: Mapped[int] = mapped_column(BigInteger, default=0)
    created_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())


def ensure_default_map(session: Session, extractor: str) -> Map:
    """The map named `default`, made on first use."""
    found = session.scalar(select(Map).where(Map.name == DEFAULT_MAP))
    if found is not None:
        return found
    try:
        with session.begin_nested():
            made = Map(name=DEFAULT_MAP, extractor=extractor)
            session.add(made)
            session.flush()
    except IntegrityError:  # another process made it between the two statements
        return session.scalars(select(Map).where(Map.name == DEFAULT_MAP)).one()
    return made


def get_map(session: Session, name: str) -> Map:
    """The map called `name`; 404 when there is none."""
    found = session.scalar(select(Map).where(Map.name == name))
    if found is None:
        raise NotFound("map_not_found", f"There is no map named {name!r}.", map=name)
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


def bump_version(session: Session, map_id: UUID) -> int:
    """One more: search workers following the map will look again. Returns the new version.

    The row stays locked until commit, so versions become visible in the order of their numbers.
    """
    return session.execute(
        update(Map).where(Map.id == map_id).values(version=Map.version + 1).returning(Map.version)
    ).scalar_one()
