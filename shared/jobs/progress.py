"""Progress and cancellation of a claimed job that runs for long."""

from __future__ import annotations

import threading
import time

from shared.catalog.database.session import Catalog
from shared.catalog.jobs import Job
from shared.jobs.leases import lock_leased_job
from shared.jobs.runner import JobInterrupted

PROGRESS_SECONDS = 0.5  # between two updates of the job's row


class JobProgress:
    """Writes the progress of a claimed job to its row from time to time."""

    def __init__(self, catalog: Catalog, job: Job, stop: threading.Event, total: int = 1) -> None:
        """`stop` is set when the worker shuts down."""
        self._catalog = catalog
        self._job = job
        self._stop = stop
        self._next_write = 0.0
        self.total = total
        self.done = 0
        self.stage = job.stage

    def update(self, done: int, stage: str | None = None) -> None:
        """Note the progress, and check as `check` does."""
        self.done, self.stage = done, stage
        self.check()

    def advance(self) -> None:
        """Note that one more part is done, and check as `check` does."""
        self.update(self.done + 1)

    def check(self) -> None:
        """Write the progress, unless that was done less than PROGRESS_SECONDS ago.

        Raises:
            JobInterrupted: The job lost its lease (it was cancelled, say), or the worker stops.
        """
        if self._stop.is_set():
            raise JobInterrupted
        if time.monotonic() < self._next_write:
            return
        self._next_write = time.monotonic() + PROGRESS_SECONDS
        with self._catalog.write() as session:
            leased = lock_leased_job(session, self._job)
            if leased is None:
                raise JobInterrupted
            leased.stage = self.stage
            leased.progress_total = max(1, self.total)
            leased.progress_done = min(self.done, leased.progress_total)
