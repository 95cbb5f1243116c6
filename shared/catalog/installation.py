"""The installation: which Placewise this catalog is, and where its objects lie.

Every object belongs to one catalog: what it does not know is collected as an orphan. So the store
carries the catalog's id (`shared.storage.ownership`), and the catalog remembers its bucket. A
restored backup of the catalog has the id in it, and so finds the store to be its own.
"""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from uuid import UUID

from sqlalchemy import BigInteger, CheckConstraint, Integer, Uuid, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Mapped, Session, mapped_column

from shared.catalog.base import Base, JsonValue, UtcDateTime, db_now
from shared.catalog.chunks import Chunk
from shared.catalog.models import Model
from shared.catalog.photos import Photo
from shared.catalog.session import Catalog
from shared.catalog.vocabularies import StoredWhitening, Vocabulary
from shared.config.settings import Settings
from shared.ids import new_id
from shared.storage import OwnedStore
from shared.storage.folder import OWNER_MARK
from shared.storage.open_store import open_store
from shared.storage.ownership import BucketLocation, bucket_location, check_free, claim_store

SAMPLE_KEYS = 20  # of each table
REBUILDING = -1  # of `Installation.journal_sequence`


class Installation(Base):
    """The one row: `id` is made at the first start and never changes."""

    __tablename__ = "installation"

    number: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=False, default=1)
    id: Mapped[UUID] = mapped_column(Uuid, default=new_id)
    # The endpoint and the name of the bucket that holds the objects; null: they lie in a folder.
    bucket: Mapped[BucketLocation | None] = mapped_column(JsonValue)
    # The number of the last journal segment that this catalog has written (`shared.journal`), or
    # REBUILDING while `placewise rebuild-catalog` has not finished.
    journal_sequence: Mapped[int] = mapped_column(BigInteger, default=0, server_default="0")
    created_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())

    __table_args__ = (CheckConstraint("number = 1", name="there_is_one"),)


def get_or_create_installation(session: Session) -> Installation:
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


def open_installation_store(catalog: Catalog, settings: Settings, *, exclusive: bool) -> OwnedStore:
    """The object store of the settings, once it is sure to be this catalog's own.

    Raises Misconfigured as `open_store` and `claim_store` do, and Unavailable for a bucket that
    can't be used now.
    """
    store = open_store(settings, exclusive=exclusive)
    with catalog.write() as session:
        installation = get_or_create_installation(session)
    place = claim_store(
        store,
        installation.id,
        installation.bucket,
        settings.placewise_home / "objects",
        lambda: _some_named_keys(catalog),
        settings.import_prefix,
    )
    if place != installation.bucket:
        with catalog.write() as session:
            get_or_create_installation(session).bucket = place
    return store


def check_before_new_catalog(catalog: Catalog, settings: Settings) -> None:
    """Refuse to create an SQLite catalog beside objects of another one, before its file exists: a
    restored file would otherwise meet the new one. Misconfigured as `open_installation_store`."""
    file = Path(catalog.url.database or "") if catalog.is_sqlite else None
    if file is not None and (not file.exists() or file.stat().st_size == 0):
        check_free(open_store(settings, exclusive=False), settings.import_prefix)


def adopt_store(catalog: Catalog, store: OwnedStore) -> None:
    """Make this catalog the owner of the store, whoever owned it."""
    with catalog.write() as session:
        installation = get_or_create_installation(session)
        store.write_note(OWNER_MARK, str(installation.id).encode())
        installation.bucket = bucket_location(store)


def _some_named_keys(catalog: Catalog) -> list[str]:
    """A sample of the keys that the catalog's rows name; [] for a catalog that names none."""
    found: list[str] = []
    with catalog.read() as session:
        for table in (Photo, Chunk, Vocabulary, StoredWhitening, Model):
            named = table.object_key.is_not(None) & (table.object_key != "")
            keys = select(table.object_key).where(named)
            if table is Photo:
                keys = keys.where(Photo.deleted_at.is_(None))
            found += filter(None, session.scalars(keys.limit(SAMPLE_KEYS)))
    return found
