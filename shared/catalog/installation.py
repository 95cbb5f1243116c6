"""The installation: the catalog's id, and the object store that belongs to it.

Objects that a catalog does not refer to are collected as orphans, so a store must belong to exactly
one catalog. The store has a mark with the catalog's id (`shared.storage.ownership`). An older copy
of the catalog has the same id, but does not know the numbers of the journal's last segments
(`check_not_behind`).
"""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from uuid import UUID

from sqlalchemy import BigInteger, CheckConstraint, Integer, Uuid, select
from sqlalchemy.orm import Mapped, Session, mapped_column

from shared.catalog.chunks import Chunk
from shared.catalog.database.base import Base, UtcDateTime, db_now, get_or_insert
from shared.catalog.database.session import Catalog
from shared.catalog.models import Model
from shared.catalog.photos import Photo
from shared.catalog.vocabularies import StoredWhitening, Vocabulary
from shared.config.settings import Settings
from shared.errors import Misconfigured
from shared.ids import new_id
from shared.storage import ObjectStore, OwnedStore
from shared.storage.keys import OWNER_MARK
from shared.storage.open_store import open_store
from shared.storage.ownership import check_free, claim_store
from shared.storage.segments import Segment, list_segments

SAMPLE_KEYS = 20  # per table
REBUILDING = -1  # special value of `Installation.journal_sequence`


class Installation(Base):
    """The table's single row; `id` is generated at the first start and never changes."""

    __tablename__ = "installation"

    number: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=False, default=1)
    id: Mapped[UUID] = mapped_column(Uuid, default=new_id)
    # Number that this catalog has taken for its last journal segment (`shared.journal`), or
    # REBUILDING until a rebuild has finished.
    journal_sequence: Mapped[int] = mapped_column(BigInteger, default=0, server_default="0")
    created_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())

    __table_args__ = (CheckConstraint("number = 1", name="there_is_one"),)


def get_or_create_installation(session: Session) -> Installation:
    """Return the installation's row, created on first use."""
    return get_or_insert(session, select(Installation), Installation())


def open_installation_store(catalog: Catalog, settings: Settings, *, exclusive: bool) -> OwnedStore:
    """Open the object store of the settings after checking that this catalog is the right one.

    Raises:
        Misconfigured: As `open_store`, `claim_store` and `check_not_behind` raise.
        Unavailable: The bucket can't be used right now.
    """
    store = open_store(settings, exclusive=exclusive)
    with catalog.write() as session:
        installation = get_or_create_installation(session)
    claim_store(store, installation.id, lambda: _sample_referenced_keys(catalog))
    check_not_behind(catalog, store)
    return store


def check_not_behind(catalog: Catalog, store: ObjectStore) -> list[Segment]:
    """Check that the catalog is not older than its object store; return the journal's segments.

    With an older one, later photos would be collected as orphans, and its changes would count as
    older than those in the journal.

    Raises:
        Misconfigured: `rebuild_unfinished`; `catalog_behind`.
        Unavailable: As the store.
    """
    segments = list_segments(store)
    # Read after listing: a number is taken before its segment is written.
    with catalog.read() as session:
        sequence = session.scalar(select(Installation.journal_sequence)) or 0
    if sequence == REBUILDING:
        raise Misconfigured(
            "rebuild_unfinished",
            "The rebuild of the catalog was interrupted. Run the same command again (`placewise "
            "storage rebuild`, or `placewise storage restore`).",
        )
    later = [segment for segment in segments if segment.last > sequence]
    if later:
        since = min(segment.modified_at for segment in later)
        raise Misconfigured(
            "catalog_behind",
            f"The catalog is older than its object store, which has changes since "
            f"{since:%Y-%m-%d %H:%M:%S} UTC that it lacks. Nothing was changed. Restore the newer "
            "catalog; or create it from the object store: stop all services, let DATABASE_URL name "
            "an empty database (or move catalog.sqlite and its -wal and -shm files away), and run "
            "`placewise storage rebuild`.",
        )
    return segments


def check_before_new_catalog(catalog: Catalog, settings: Settings) -> None:
    """Refuse to create an SQLite catalog for a store that has objects of another catalog.

    Checked before the file exists, because it would be in the way of a restored one.

    Raises:
        Misconfigured: As `open_installation_store` raises.
    """
    file = Path(catalog.url.database or "") if catalog.is_sqlite else None
    if file is not None and (not file.exists() or file.stat().st_size == 0):
        check_free(open_store(settings, exclusive=False))


def adopt_store(catalog: Catalog, store: OwnedStore) -> None:
    """Make this catalog the owner of the store, also if another or a newer catalog owns it."""
    last = max((segment.last for segment in list_segments(store)), default=0)
    with catalog.write() as session:
        installation = get_or_create_installation(session)
        store.write_note(OWNER_MARK, str(installation.id).encode())
        if installation.journal_sequence != REBUILDING:
            installation.journal_sequence = max(installation.journal_sequence, last)


def _sample_referenced_keys(catalog: Catalog) -> list[str]:
    """Return a sample of the object keys that the catalog's rows refer to."""
    sample: list[str] = []
    with catalog.read() as session:
        for table in (Photo, Chunk, Vocabulary, StoredWhitening, Model):
            has_object = table.object_key.is_not(None) & (table.object_key != "")
            keys = select(table.object_key).where(has_object)
            if table is Photo:
                keys = keys.where(Photo.deleted_at.is_(None))
            sample += filter(None, session.scalars(keys.limit(SAMPLE_KEYS)))
    return sample
