"""What the processes of the separate services share: their set-up, and their background threads."""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Callable, Iterator
from uuid import UUID

from shared.catalog.database.schema import migrate, wait_for_schema
from shared.catalog.database.session import Catalog
from shared.catalog.installation import get_or_create_installation
from shared.catalog.tables import open_catalog
from shared.config.settings import Settings
from shared.telemetry.logs import configure_logging
from shared.telemetry.tracing import configure_tracing

log = logging.getLogger(__name__)

RunUntilStopped = Callable[[threading.Event], None]
"""Runs until the event is set."""

Announce = Callable[[str], None]
"""Shows a message to the operator once the service is ready."""


@contextlib.contextmanager
def service_process(settings: Settings, name: str) -> Iterator[Catalog]:
    """Set up logging and tracing, and open the catalog once its schema is current.

    Raises:
        Misconfigured, Unavailable: As `wait_for_schema` raises them.
    """
    configure_logging(settings, name)
    with (
        configure_tracing(settings, name),
        contextlib.closing(open_catalog(settings, name)) as catalog,
    ):
        wait_for_schema(catalog, settings.schema_wait_seconds)
        yield catalog


def migrate_catalog(settings: Settings) -> UUID:
    """Migrate the catalog's schema to this release; returns the id of the installation."""
    configure_logging(settings, "migrate", to_file=False)
    with contextlib.closing(open_catalog(settings, "migrate")) as catalog:
        migrate(catalog)
        with catalog.write() as session:
            return get_or_create_installation(session).id


def start_service_thread(
    name: str, run: RunUntilStopped, stop: threading.Event, on_crash: Callable[[], None]
) -> threading.Thread:
    """Starts `run(stop)` in a thread; logs its exception and calls `on_crash` if it raises."""

    def guarded() -> None:
        try:
            run(stop)
        except BaseException:
            log.exception("the service thread %s crashed", name)
            on_crash()

    thread = threading.Thread(target=guarded, name=name)
    thread.start()
    return thread
