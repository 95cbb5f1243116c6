"""The extractor of an embedded server: a process of its own, with an interpreter of its own.

In the server's process, each photo would wait for the threads of uploads and searches, and each
query for those of the extractor. Both processes use the same catalog and object store. What else
they would share in one process passes through two pipes: that something was committed or queued,
log records, metrics, and the error with which the extractor ends.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import select
import signal
import threading
from collections.abc import Callable, Iterator
from logging import LogRecord, getLogger
from multiprocessing.connection import Connection
from pathlib import Path

from filelock import FileLock
from prometheus_client import CollectorRegistry, Metric, generate_latest
from prometheus_client.parser import text_string_to_metric_families
from prometheus_client.registry import Collector

from services.service_process import (
    SIGNAL_POLL_SECONDS,
    start_service_threads,
    stop_when_a_thread_crashes,
)
from shared.catalog.database.session import Catalog
from shared.catalog.installation import open_installation_store
from shared.catalog.processes import process_heartbeat
from shared.catalog.tables import open_catalog
from shared.config.settings import Settings
from shared.errors import Misconfigured, PlacewiseError
from shared.jobs import InProcessWakeups
from shared.telemetry.logs import forward_logs
from shared.telemetry.tracing import configure_tracing

# Commands are single bytes: any number of them is one. The end of their pipe means: stop.
LOOK, REPORT_METRICS = b"l", b"m"
METRICS_SECONDS = 2.0  # that a request for metrics waits for those of the extractor
ORPHAN_SECONDS = 30.0  # in which the extractor of a killed server ends

# A terminal and systemd send them to both processes; the server's end is what stops the extractor.
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)

Message = LogRecord | PlacewiseError | str | None
"""From the extractor: a log record, the error it ends with, its metrics, or None: a commit."""


def extractor_lock(home: Path) -> FileLock:
    """Return the lock that the extractor of a server on this folder holds until it ends."""
    return FileLock(home / "extractor.lock", timeout=ORPHAN_SECONDS)


class ExtractorProcess(Collector):
    """The extractor's process, as its server sees it. Collects its metrics."""

    def __init__(self, catalog: Catalog, settings: Settings, name: str) -> None:
        """Take `name` as that of its leases. `run` starts the process."""
        self._catalog, self._settings, self._name = catalog, settings, name
        self._commands: Connection | None = None
        self._commands_lock = threading.Lock()
        self._metrics = ""
        self._reports = 0  # of metrics; the first one when the extractor is ready
        self._reported = threading.Condition()

    def run(self, stop: threading.Event) -> None:
        """Run the process until it ends: after `end`, or because it can't go on.

        Raises:
            PlacewiseError: As `ExtractorWorker` raises it; Misconfigured `extractor_ended`.
        """
        context = multiprocessing.get_context("spawn")  # forking is not safe beside threads
        commands, writer = context.Pipe(duplex=False)
        reader, messages = context.Pipe(duplex=False)
        os.set_blocking(writer.fileno(), False)
        process = context.Process(
            target=_run_extractor,
            args=[self._settings, self._name, commands, messages],
            name="extractor",
        )
        # The child inherits the mask: no signal ends it before it has handlers.
        signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)
        process.start()
        signal.pthread_sigmask(signal.SIG_UNBLOCK, STOP_SIGNALS)
        commands.close()
        messages.close()
        with self._commands_lock:
            self._commands = writer
        if stop.is_set():
            self.end()
        error = None
        with reader, contextlib.suppress(EOFError, OSError):  # OSError: within a message
            while True:
                error = self._receive(reader.recv()) or error
        process.join()
        self.end()
        if error is not None:
            raise error
        if process.exitcode:
            raise Misconfigured(
                "extractor_ended",
                f"The extractor's process ended with code {process.exitcode}; -9 means that it was "
                "killed, perhaps because memory ran out. Nothing is lost: start the server again.",
            )

    def look(self) -> None:
        """Make the extractor look for jobs, and its loops for changes of the catalog."""
        self._command(LOOK)

    def end(self) -> None:
        """Let the extractor end after what it does now."""
        with self._commands_lock:
            if self._commands is not None:
                self._commands.close()
            self._commands = None

    def collect(self) -> Iterator[Metric]:
        """Yield the extractor's metrics; none while it starts, or if it does not answer."""
        with self._reported:
            seen = self._reports
            if seen == 0 or not self._command(REPORT_METRICS):
                return
            if not self._reported.wait_for(lambda: self._reports != seen, METRICS_SECONDS):
                return
            text = self._metrics
        yield from text_string_to_metric_families(text)

    def _command(self, command: bytes) -> bool:
        # A full pipe has commands that the extractor has yet to read.
        with self._commands_lock, contextlib.suppress(BlockingIOError, BrokenPipeError):
            if self._commands is not None:
                os.write(self._commands.fileno(), command)
                return True
        return False

    def _receive(self, message: Message) -> PlacewiseError | None:
        if isinstance(message, PlacewiseError):
            return message
        if isinstance(message, LogRecord):
            getLogger(message.name).handle(message)
        elif isinstance(message, str):
            with self._reported:
                self._metrics = message
                self._reports += 1
                self._reported.notify_all()
        else:
            self._catalog.commits.count_one()
        return None


def _run_extractor(
    settings: Settings, name: str, commands: Connection, messages: Connection
) -> None:
    """Run the extractor in this process until the pipe of commands ends."""
    threading.Thread(target=_exit_with_server, daemon=True).start()
    for number in STOP_SIGNALS:
        # Not SIG_IGN, which the decoders would inherit.
        signal.signal(number, lambda *_: None)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, STOP_SIGNALS)
    sending = threading.Lock()

    def send(message: Message) -> None:
        with sending:
            messages.send(message)

    forward_logs(settings, send)
    try:
        _serve_extractor(settings, name, commands, send)
    except PlacewiseError as error:
        send(error)
        raise SystemExit(1) from None


def _serve_extractor(
    settings: Settings, name: str, commands: Connection, send: Callable[[Message], None]
) -> None:
    from services.extractor.worker import ExtractorWorker  # torch: seconds

    stop = threading.Event()
    registry = CollectorRegistry()
    with (
        extractor_lock(settings.placewise_home),
        stop_when_a_thread_crashes(stop.set),
        configure_tracing(settings, "embedded"),
        contextlib.closing(open_catalog(settings, "embedded")) as catalog,
    ):
        store = open_installation_store(catalog, settings, exclusive=False)
        wakeups = InProcessWakeups()
        catalog.commits.announce = lambda: send(None)
        with (
            contextlib.closing(
                ExtractorWorker(catalog, store, settings, name, only_worker=True, registry=registry)
            ) as worker,
            process_heartbeat(catalog, "extractor", worker.state),
        ):

            def run_jobs(stop: threading.Event) -> None:
                worker.warm_up(stop)
                worker.run(stop, wakeups.wait)

            threads = start_service_threads({"extractor": run_jobs, "fits": worker.fits.run}, stop)
            send(generate_latest(registry).decode())
            while not stop.is_set():
                if not select.select([commands], [], [], SIGNAL_POLL_SECONDS)[0]:
                    continue
                received = os.read(commands.fileno(), select.PIPE_BUF)
                if not received:
                    stop.set()
                if REPORT_METRICS in received:
                    send(generate_latest(registry).decode())
                if LOOK in received:
                    catalog.commits.count_one()
                    wakeups.send()
            wakeups.send()
            for thread in threads:
                thread.join()


def _exit_with_server() -> None:
    server = multiprocessing.parent_process()
    assert server is not None
    server.join()
    os._exit(1)
