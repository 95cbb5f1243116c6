"""`placewise extractor`: one of the separate services, for deployments on several machines."""

from __future__ import annotations

from services.cli.configuration import read_settings
from services.cli.output import explained
from services.cli.serve import set_log_levels
from shared.catalog.session import Catalog
from shared.objects.open_store import open_store


def extractor() -> None:
    """Describe photos: a Celery worker on REDIS_URL, DATABASE_URL and the object store."""
    with explained(as_json=False):
        settings = read_settings()
        from services.extractor.service import serve_extractor  # brings torch

        set_log_levels(settings.debug)
        catalog = Catalog(settings.catalog_url())
        try:
            serve_extractor(catalog, open_store(settings, alone=False), settings)
        finally:
            catalog.close()
