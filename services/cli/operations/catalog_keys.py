"""The API keys of a catalog, without a server: this is how the first admin key is created."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any
from uuid import UUID

from placewise.answers import CreatedKey, Key
from shared.catalog.api_keys import (
    ApiKey,
    KeyLimits,
    create_api_key,
    list_api_keys,
    revoke_api_key,
)
from shared.catalog.database.schema import wait_for_schema
from shared.catalog.database.session import Catalog
from shared.catalog.maps import Map, list_maps
from shared.catalog.tables import open_catalog
from shared.config.settings import Settings
from shared.security.api_keys import Scope
from shared.telemetry.logs import configure_logging

SECONDS_PER_DAY = 86_400.0


class CatalogKeys:
    """The calls of the client about keys, on the catalog itself."""

    def __init__(self, catalog: Catalog) -> None:
        self._catalog = catalog

    def create_key(
        self,
        name: str,
        scopes: Sequence[Scope],
        days: float | None,
        maps: list[str] | None,
        **limits: int | None,
    ) -> CreatedKey:
        life_seconds = None if days is None else days * SECONDS_PER_DAY
        with self._catalog.write() as session:
            row, secret = create_api_key(
                session,
                name,
                set(scopes),
                life_seconds=life_seconds,
                limits=KeyLimits(**limits),
                maps=maps,
            )
            return CreatedKey(**_key_fields(row), key=secret)

    def keys(self) -> list[Key]:
        with self._catalog.read() as session:
            return [Key(**_key_fields(row)) for row in list_api_keys(session)]

    def maps(self) -> list[Map]:
        with self._catalog.read() as session:
            return list_maps(session)

    def revoke_key(self, key_id: UUID) -> Key:
        with self._catalog.write() as session:
            return Key(**_key_fields(revoke_api_key(session, key_id)))


@contextlib.contextmanager
def open_catalog_keys(settings: Settings) -> Iterator[CatalogKeys]:
    """Open the keys of the catalog of the settings.

    Raises:
        Misconfigured, Unavailable: As `wait_for_schema` raises them.
    """
    configure_logging(settings, "keys", to_file=False)
    with contextlib.closing(open_catalog(settings, "keys")) as catalog:
        wait_for_schema(catalog, 0)
        yield CatalogKeys(catalog)


def _key_fields(row: ApiKey) -> dict[str, Any]:
    return {name: getattr(row, name) for name in Key.model_fields}
