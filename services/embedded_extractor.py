"""The extractor of an embedded server: a process of its own, with an interpreter of its own.

In the server's process, each photo would wait for the threads of uploads and searches, and each
query for those of the extractor. Both processes use the same catalog and object store. What else
they would share in one process passes through two pipes: that something was committed or queued,
metrics, and the error with which the extractor ends.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import select
import signal
import threading
from collections.abc import Callable, Iterator
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path

from filelock import FileLock
from prometheus_client import CollectorRegistry, Metric, generate_latest
from prometheus_client.parser import text_string_to_metric_families
from prometheus_client.registry import Collector

from services.extractor.child_process import exit_with_parent
from services.service_process import (
    SIGNAL_POLL_SECONDS,
    start_service_threads,
    stop_when_a_thread_crashes,
)
from shared.catalog.database.session import Catalog
from shared.catalog.installation import open_installation_store
from shared.catalog.jobs import EXTRACTOR_JOBS
from shared.catalog.processes import process_heartbeat
from shared.catalog.tables import open_catalog
from shared.config.private_files import FILE_MODE
from shared.config.settings import Settings
from shared.errors import Misconfigured, PlacewiseError
from shared.jobs import InProcessWakeups
from shared.jobs.runner import IDLE_POLL_SECONDS, JobRunner
from shared.storage import ObjectStore
from shared.telemetry.logs import configure_logging

# Commands are single bytes: any number of them is one. The end of their pipe means: stop.
LOOK, REPORT_METRICS = b"l", b"m"
METRICS_SECONDS = 2.0  # that a request for metrics waits for those of the extractor
ORPHAN_SECONDS = 30.0  # for the extractor of a killed server to end

# A terminal and systemd send them to both processes; the server's end is what stops the extractor.
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)

Message = PlacewiseError | str | None
"""From the extractor: the error it ends with, its metrics, or None: a commit."""


def extractor_lock(home: Path) -> FileLock:
    """Return the lock that the extractor of a server on this folder holds until it ends."""
    return FileLock(home / "extractor.lock", timeout=ORPHAN_SECONDS, mode=FILE_MODE)


class ExtractorProcess(Collector):
    """The extractor's process, as its server sees it. Collects its metrics.

    Create it before any thread and lock: where processes are forked, the child has them, too.
    """

    def __init__(self, settings: Settings, name: str, *, lazy: bool) -> None:
        """Start the process, which waits for the first `look`.

        Args:
            settings: Those of the server.
            name: Name for its leases.
            lazy: Load the extractor only when the first of its jobs is queued.
        """
        commands, self._commands = multiprocessing.Pipe(duplex=False)
        self._messages, messages = multiprocessing.Pipe(duplex=False)
        os.set_blocking(self._commands.fileno(), False)
        pipes = (commands, self._commands, self._messages, messages)
        self._process = multiprocessing.Process(
            target=_run, args=[settings, name, lazy, pipes], name="extractor"
        )
        # The child inherits the mask: no signal ends it before it has handlers.
        signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)
        self._process.start()
        signal.pthread_sigmask(signal.SIG_UNBLOCK, STOP_SIGNALS)
        commands.close()
        messages.close()
        self._commands_lock = threading.Lock()
        self._metrics = ""
        self._reports = 0  # of metrics
        self._reported = threading.Condition()

    def run(self, catalog: Catalog) -> None:
        """Receive what the process sends until it ends: after `end`, or because it can't go on.

        Raises:
            PlacewiseError: As `ExtractorWorker` raises it; Misconfigured `extractor_ended`.
        """
        error = None
        with contextlib.suppress(EOFError, OSError):  # OSError: it ended within a message
            while True:
                message: Message = self._messages.recv()
                if isinstance(message, PlacewiseError):
                    error = message
                elif isinstance(message, str):
                    self._take_metrics(message)
                else:
                    catalog.commits.count_one()
        self.end()
        if error is not None:
            raise error
        if self._process.exitcode:
            raise Misconfigured(
                "extractor_ended",
                f"The extractor's process ended with code {self._process.exitcode}; -9 means that "
                "it was killed, perhaps because memory ran out. Nothing is lost: start the server "
                "again.",
            )

    def end(self) -> None:
        """Let the process end after what it does now, and wait for its end."""
        with self._commands_lock:
            self._commands.close()
        self._process.join()

    def look(self) -> None:
        """Make the extractor look for jobs, and its loops for changes of the catalog."""
        self._command(LOOK)

    def collect(self) -> Iterator[Metric]:
        """Yield the extractor's metrics; none while it starts, or if it does not answer."""
        with self._reported:
            seen = self._reports
            self._command(REPORT_METRICS)
            if not self._reported.wait_for(lambda: self._reports != seen, METRICS_SECONDS):
                return
            text = self._metrics
        yield from text_string_to_metric_families(text)

    def _command(self, command: bytes) -> None:
        # A full pipe has commands that the process has yet to read.
        with self._commands_lock, contextlib.suppress(BlockingIOError, BrokenPipeError):
            if not self._commands.closed:
                os.write(self._commands.fileno(), command)

    def _take_metrics(self, text: str) -> None:
        with self._reported:
            self._metrics = text
            self._reports += 1
            self._reported.notify_all()


class _Extractor:
    """The extractor, in its process."""

    def __init__(self, settings: Settings, name: str, send: Callable[[Message], None]) -> None:
        self._settings, self._name, self._send = settings, name, send
        self._registry = CollectorRegistry()
        self._wakeups = InProcessWakeups()
        self._stop = threading.Event()
        self._error: PlacewiseError | None = None

    def serve(self, commands: Connection, *, lazy: bool) -> None:
        """Follow commands until their pipe ends, or the extractor can't go on.

        Raises:
            PlacewiseError: As `ExtractorWorker` and `stop_when_a_thread_crashes` raise it.
        """
        stop = self._stop
        if not os.read(commands.fileno(), 1):
            return
        with (
            extractor_lock(self._settings.placewise_home),
            stop_when_a_thread_crashes(stop.set),
            contextlib.closing(open_catalog(self._settings, "embedded")) as catalog,
        ):
            catalog.commits.announce = lambda: self._send(None)
            run = partial(self._run, catalog, lazy=lazy)
            (thread,) = start_service_threads({"extractor": run}, stop)
            while not stop.is_set():
                if not select.select([commands], [], [], SIGNAL_POLL_SECONDS)[0]:
                    continue
                received = os.read(commands.fileno(), select.PIPE_BUF)
                if REPORT_METRICS in received:
                    self._send(generate_latest(self._registry).decode())
                if LOOK in received:
                    catalog.commits.count_one()
                    self._wakeups.send()
                if not received:
                    stop.set()
            self._wakeups.send()
            thread.join()
        if self._error is not None:
            raise self._error

    def _run(self, catalog: Catalog, stop: threading.Event, *, lazy: bool) -> None:
        try:
            store = open_installation_store(catalog, self._settings, exclusive=False)
            if lazy:
                self._wait_for_jobs(catalog)
            if not stop.is_set():
                self._run_jobs(catalog, store)
        except PlacewiseError as error:
            self._error = error
            stop.set()

    def _run_jobs(self, catalog: Catalog, store: ObjectStore) -> None:
        from services.extractor.worker import ExtractorWorker  # imports torch: seconds

        with (
            contextlib.closing(
                ExtractorWorker(
                    catalog,
                    store,
                    self._settings,
                    self._name,
                    only_worker=True,
                    registry=self._registry,
                )
            ) as worker,
            process_heartbeat(catalog, "extractor", worker.state),
        ):
            (fits,) = start_service_threads({"fits": worker.fits.run}, self._stop)
            worker.warm_up(self._stop)
            worker.run(self._stop, self._wakeups.wait)
            fits.join()

    def _wait_for_jobs(self, catalog: Catalog) -> None:
        runner = JobRunner(catalog, self._settings, "extractor", EXTRACTOR_JOBS, lambda *_: None)
        while not self._stop.is_set() and not runner.run_once(runner.has_jobs, self._stop):
            self._wakeups.wait(IDLE_POLL_SECONDS)


def _run(
    settings: Settings,
    name: str,
    lazy: bool,
    pipes: tuple[Connection, Connection, Connection, Connection],
) -> None:
    exit_with_parent()
    for number in STOP_SIGNALS:
        signal.signal(number, lambda *_: None)  # not SIG_IGN, which the decoders would inherit
    signal.pthread_sigmask(signal.SIG_UNBLOCK, STOP_SIGNALS)
    commands, *of_the_server, messages = pipes
    for connection in of_the_server:
        connection.close()
    sending = threading.Lock()

    def send(message: Message) -> None:
        with sending:
            messages.send(message)

    configure_logging(settings, "embedded", for_operators=False)
    try:
        _Extractor(settings, name, send).serve(commands, lazy=lazy)
    except PlacewiseError as error:
        send(error)
