"""The catalog and the store of the settings, for commands that look at what is there."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from sqlalchemy.exc import SQLAlchemyError

from shared.catalog.away import to_unavailable
from shared.catalog.connections import NO_TIMEOUTS
from shared.catalog.installation import open_installation_store
from shared.catalog.open_catalog import open_catalog
from shared.catalog.schema import check_schema
from shared.catalog.session import Catalog
from shared.catalog.unusable import opening
from shared.errors import Misconfigured
from shared.objects import OwnedStore
from shared.settings import Settings


@contextlib.contextmanager
def open_storage(settings: Settings, command: str) -> Iterator[tuple[Catalog, OwnedStore]]:
    """Both, while the service runs or not.

    Raises Misconfigured: `nothing_stored` for a folder without a catalog, those of `check_schema`
    and of `open_installation_store`; Unavailable while one of them is away.
    """
    if settings.database_url is None and not (settings.placewise_home / "catalog.sqlite").exists():
        raise Misconfigured(
            "nothing_stored",
            f"There is no catalog in {settings.placewise_home}: give the PLACEWISE_HOME that is "
            "served, or DATABASE_URL.",
        )
    catalog = open_catalog(settings, command, NO_TIMEOUTS)
    try:
        with opening(catalog):
            check_schema(catalog)
        yield catalog, open_installation_store(catalog, settings, exclusive=False)
    except SQLAlchemyError as error:
        unavailable = to_unavailable(error)
        if unavailable is None:
            raise
        raise unavailable from error
    finally:
        catalog.close()
