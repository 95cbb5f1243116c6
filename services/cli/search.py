"""`placewise search`: one search worker, for a shard of every map."""

from __future__ import annotations

from services.cli.configuration import read_settings
from services.cli.output import err_console, report_errors
from shared.telemetry.logs import configure_logging
from shared.telemetry.traces import configure_tracing


def search() -> None:
    """Answer searches over HTTP (HOST, PORT) for the part of the maps that SEARCH_SHARD names.

    DATABASE_URL is the catalog that it follows. It asks for no key: let only the gateway and the
    steward reach it, which find it by SEARCH_URLS.
    """
    with report_errors(as_json=False):
        settings = read_settings()
        # Imported only here: the other commands need no server.
        from services.search.server import run_search_service
        from shared.catalog.installation import open_installation_store
        from shared.catalog.open_catalog import open_catalog
        from shared.catalog.schema import wait_for_schema

        configure_logging(settings, "search")
        catalog = open_catalog(settings, "search")
        try:
            wait_for_schema(catalog, settings.schema_wait_seconds)
            store = open_installation_store(
                catalog, settings, exclusive=False
            )  # others write there meanwhile
            with (
                configure_tracing(settings, "search"),
                run_search_service(settings, catalog, store) as running,
            ):
                err_console.print(
                    f"Placewise search serves shard {settings.shard} on {running.url}\n"
                    f"  look:     {running.url}/readyz   {running.url}/metrics",
                    soft_wrap=True,
                )
                running.serve()
        finally:
            catalog.close()
