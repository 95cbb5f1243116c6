"""Making an empty catalog the owner of a store that another catalog has filled."""

from __future__ import annotations

from uuid import UUID

from sqlalchemy import delete, select
from sqlalchemy.orm import Session

from shared.backup.rows import backup_tables
from shared.catalog.figures import CachedMapStatistics
from shared.catalog.installation import (
    REBUILDING,
    Installation,
    adopt_store,
    get_or_create_installation,
)
from shared.catalog.keys import ApiKey
from shared.catalog.maps import DEFAULT_MAP, Map
from shared.catalog.models import Model
from shared.catalog.session import Catalog
from shared.errors import Conflict, Unavailable
from shared.journal.segments import list_segments, read_segment
from shared.objects import ObjectStore, OwnedStore
from shared.objects.store_owner import read_owner

# What a first start, or an interrupted rebuild, may have left.
MAY_HAVE_ROWS = {
    table.__tablename__ for table in (ApiKey, Installation, Map, CachedMapStatistics, Model)
}


def begin_rebuild(catalog: Catalog, store: OwnedStore) -> None:
    """Note that a rebuild is under way, and take over the id that the store is marked with.

    Raises Conflict (`catalog_not_empty`) unless the catalog is empty, or a rebuild of it was
    interrupted.
    """
    mark = read_owner(store)
    owner = UUID(mark) if mark else _writer_of_journal(store)
    with catalog.write() as session:
        installation = get_or_create_installation(session)
        if installation.journal_sequence != REBUILDING:
            _check_empty(session)
            session.execute(delete(CachedMapStatistics))
            session.execute(delete(Map))
            installation.journal_sequence = REBUILDING
        if owner is not None:
            installation.id = owner
    adopt_store(catalog, store)


def _check_empty(session: Session) -> None:
    filled = [
        table.name
        for table in backup_tables()
        if table.name not in MAY_HAVE_ROWS
        and session.execute(select(table).limit(1)).first() is not None
    ]
    if filled or any(name != DEFAULT_MAP for name in session.scalars(select(Map.name))):
        raise Conflict(
            "catalog_not_empty",
            "Only an empty catalog is rebuilt, and this one holds "
            f"{', '.join(filled) or 'maps'}. `placewise verify --repair` brings what is missing "
            "into it; or give a new database (DATABASE_URL), or move catalog.sqlite away.",
        )


def _writer_of_journal(store: ObjectStore) -> UUID | None:
    for segment in reversed(list_segments(store)):
        try:
            return read_segment(store, segment.key).installation_id
        except Unavailable as error:
            if error.code != "journal_damaged":
                raise
    return None
