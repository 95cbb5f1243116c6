"""What the processes of the separate services share: their set-up, and their background threads."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping

from shared.catalog.database.schema import wait_for_schema
from shared.catalog.database.session import Catalog
from shared.catalog.tables import open_catalog
from shared.config.settings import Settings
from shared.errors import Misconfigured
from shared.telemetry.logs import configure_logging

log = logging.getLogger(__name__)

# That a starting service gives the catalog and `placewise storage migrate`.
SCHEMA_WAIT_SECONDS = 60.0

# Python runs a signal's handler when the main thread is awake. A signal that arrives just as the
# thread blocks is handled when that ends.
SIGNAL_POLL_SECONDS = 1.0

RunUntilStopped = Callable[[threading.Event], None]
"""Runs until the event is set."""

Announce = Callable[[str], None]
"""Shows a message to the operator once the service is ready."""


@contextlib.contextmanager
def service_process(settings: Settings, name: str) -> Iterator[Catalog]:
    """Set up logging, and open the catalog once its schema is current.

    A thread that crashes stops the process as SIGTERM does.

    Raises:
        Misconfigured: As `wait_for_schema` and `stop_when_a_thread_crashes` raise it.
        Unavailable: As `wait_for_schema` raises it.
    """
    configure_logging(settings, name)
    with (
        stop_when_a_thread_crashes(lambda: os.kill(os.getpid(), signal.SIGTERM)),
        contextlib.closing(open_catalog(settings, name)) as catalog,
    ):
        wait_for_schema(catalog, SCHEMA_WAIT_SECONDS)
        yield catalog


@contextlib.contextmanager
def stop_when_a_thread_crashes(stop: Callable[[], object]) -> Iterator[None]:
    """Call `stop` when any thread ends with an exception while the block runs.

    It holds for every thread of the process, also for those that a library has started: a service
    of which a part is dead must not look healthy.

    Raises:
        Misconfigured: `thread_crashed`, when the block ends after such an exception.
    """
    crashed = threading.Event()

    def on_crash(crash: threading.ExceptHookArgs) -> None:
        if crash.exc_type is SystemExit:  # ends a thread quietly, as in Python's own hook
            return
        name = crash.thread.name if crash.thread else "unknown"
        log.critical("the thread %s crashed", name, exc_info=crash.exc_value)
        crashed.set()
        stop()

    previous, threading.excepthook = threading.excepthook, on_crash
    try:
        yield
    finally:
        threading.excepthook = previous
        if crashed.is_set():
            raise Misconfigured(
                "thread_crashed", "A thread crashed. Its exception is in the log above."
            )


def start_service_threads(
    runs: Mapping[str, RunUntilStopped], stop: threading.Event
) -> list[threading.Thread]:
    """Start a thread of each name, which runs until `stop` is set."""
    threads = [threading.Thread(target=run, args=[stop], name=name) for name, run in runs.items()]
    for thread in threads:
        thread.start()
    return threads
