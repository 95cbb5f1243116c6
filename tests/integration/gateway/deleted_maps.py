"""What the tests of deleted maps share: what is left of a map, and its removal."""

from __future__ import annotations

from collections import Counter
from uuid import UUID

from sqlalchemy import func, select

from services.steward.tasks.delete_maps import purge_deleted_maps
from shared.catalog.database.base import Base
from shared.catalog.database.session import Catalog
from shared.catalog.installation import Installation
from shared.catalog.maps import Map
from shared.catalog.models import Model
from shared.catalog.processes import RegisteredProcess
from shared.storage import FolderStore
from shared.storage.keys import JOURNAL, TRASH
from tests.integration.in_process_api import Service

ROUNDS = 50

OF_NO_MAP = {kind.__tablename__ for kind in (Installation, Model, RegisteredProcess)}


def rows(catalog: Catalog) -> Counter[str]:
    """How many rows lie in each table but those that belong to no map."""
    with catalog.read() as session:
        return Counter(
            {
                table.name: session.scalar(select(func.count()).select_from(table)) or 0
                for table in Base.metadata.sorted_tables
                if table.name not in OF_NO_MAP
            }
        )


def objects(store: FolderStore) -> set[str]:
    """All but the trash, and the journal, which tells of the deletion."""
    return {info.key for info in store.list("") if not info.key.startswith((JOURNAL, TRASH))}


def id_of(service: Service, name: str) -> UUID:
    with service.catalog.read() as session:
        return session.scalars(select(Map.id).where(Map.name == name)).one()


def remove_all(catalog: Catalog, store: FolderStore) -> None:
    """The steward's rounds until no deleted map is left."""
    for _ in range(ROUNDS):
        purge_deleted_maps(catalog, store)
        with catalog.read() as session:
            if not session.scalars(select(Map.id).where(Map.deleted_at.is_not(None))).all():
                return
    raise AssertionError("a deleted map is still there")
