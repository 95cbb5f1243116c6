"""The catalog that the settings name, with every table known."""

from __future__ import annotations

# A foreign key may lead to a table whose module the service itself never needs.
import shared.catalog.tables  # noqa: F401
from shared.catalog.connections import PoolConfig, TransactionTimeouts
from shared.catalog.session import Catalog
from shared.settings import Settings


def open_catalog(
    settings: Settings, service: str, limits: TransactionTimeouts | None = None
) -> Catalog:
    """The catalog that the settings name, for a service of this name; `limits` are those of
    background work unless given."""
    return Catalog(
        settings.catalog_url(),
        PoolConfig.from_settings(settings, service),
        TransactionTimeouts.for_background(settings) if limits is None else limits,
    )
