"""`placewise migrate`: the catalog's tables, once, before the services start."""

from __future__ import annotations

from services.cli.configuration import read_settings
from services.cli.output import explained, messages
from shared.catalog.installation import ensure_installation
from shared.catalog.session import Catalog


def migrate() -> None:
    """Bring the catalog's tables (DATABASE_URL) up to this release, and end."""
    with explained(as_json=False):
        catalog = Catalog(read_settings().catalog_url())
        try:
            catalog.migrate()
            with catalog.write() as session:
                installation = ensure_installation(session)
            messages.print(f"The catalog is up to date (installation {installation.id}).")
        finally:
            catalog.close()
