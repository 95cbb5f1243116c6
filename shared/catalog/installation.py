"""The installation: which Placewise this catalog is, and where its objects lie.

Every object belongs to one catalog: what it does not know is removed as an orphan. So the bucket
carries the catalog's id (`shared.objects.bucket_owner`), and the catalog remembers its bucket. A
restored backup of the catalog has the id in it, and so finds the bucket to be its own.
"""

from __future__ import annotations

from datetime import datetime
from uuid import UUID

from sqlalchemy import BigInteger, CheckConstraint, Integer, Uuid, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Mapped, Session, mapped_column

from shared.catalog.base import Base, JsonValue, UtcDateTime, db_now
from shared.catalog.session import Catalog
from shared.ids import new_id
from shared.objects import ObjectStore
from shared.objects.bucket_owner import Place, check_no_bucket, claim_bucket
from shared.objects.open_store import open_store
from shared.objects.s3 import S3Store
from shared.settings import Settings

REBUILDING = -1  # of `Installation.journal_sequence`


class Installation(Base):
    """The one row: `id` is made at the first start and never changes."""

    __tablename__ = "installation"

    number: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=False, default=1)
    id: Mapped[UUID] = mapped_column(Uuid, default=new_id)
    # The endpoint and the name of the bucket that holds the objects; null: they lie in a folder.
    bucket: Mapped[Place | None] = mapped_column(JsonValue)
    # The number of the last journal segment that this catalog has written (`shared.journal`), or
    # REBUILDING while `placewise rebuild-catalog` has not finished.
    journal_sequence: Mapped[int] = mapped_column(BigInteger, default=0, server_default="0")
    created_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())

    __table_args__ = (CheckConstraint("number = 1", name="there_is_one"),)


def ensure_installation(session: Session) -> Installation:
    """The catalog's row, made on first use."""
    found: Installation | None = session.scalar(select(Installation))
    if found is not None:
        return found
    try:
        with session.begin_nested():
            made = Installation()
            session.add(made)
            session.flush()
    except IntegrityError:  # another process made it between the two statements
        return session.scalars(select(Installation)).one()
    return made


def open_own_store(catalog: Catalog, settings: Settings, *, alone: bool) -> ObjectStore:
    """The object store of the settings, once it is sure to be this catalog's own.

    Raises Misconfigured as `open_store`, `claim_bucket` and `check_no_bucket` do, and Unavailable
    for a bucket that can't be used now.
    """
    store = open_store(settings, alone=alone)
    with catalog.write() as session:
        installation = ensure_installation(session)
    if not isinstance(store, S3Store):
        check_no_bucket(installation.bucket)
        return store
    place = claim_bucket(
        store, installation.id, installation.bucket, settings.placewise_home / "objects"
    )
    if place != installation.bucket:
        with catalog.write() as session:
            ensure_installation(session).bucket = place
    return store
