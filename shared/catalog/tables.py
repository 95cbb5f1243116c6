"""Imports every table, for the schema and for foreign keys, and opens the configured catalog."""

from __future__ import annotations

from sqlalchemy.exc import ArgumentError

# A foreign key may refer to a table whose module a service does not import itself.
from shared.catalog import (  # noqa: F401
    api_keys,
    batch_items,
    chunks,
    generations,
    idempotency,
    installation,
    jobs,
    maps,
    models,
    photos,
    processes,
    reconstructions,
    tracks,
    vocabularies,
    webhooks,
)
from shared.catalog.database.session import (
    BACKGROUND_TIMEOUTS,
    Catalog,
    PoolConfig,
    TransactionTimeouts,
)
from shared.config.settings import Settings
from shared.errors import Misconfigured


def open_catalog(
    settings: Settings, service: str, limits: TransactionTimeouts = BACKGROUND_TIMEOUTS
) -> Catalog:
    """Open the catalog of the settings; `pg_stat_activity` shows the name of the service.

    Raises:
        Misconfigured: `bad_setting`, if DATABASE_URL is malformed.
    """
    try:
        return Catalog(settings.catalog_url(), PoolConfig(f"placewise-{service}"), limits)
    except (ArgumentError, ValueError):  # its text may contain a part of the password
        raise Misconfigured(
            "bad_setting",
            "DATABASE_URL is malformed; expected postgresql://USER:PASSWORD@HOST:PORT/DATABASE, "
            "with a number as the port and special characters of the password as %XX.",
        ) from None
