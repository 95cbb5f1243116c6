"""How far a job is that asks many questions, and whether it is to go on."""

from __future__ import annotations

import threading
import time

from services.steward.take import JobInterrupted
from shared.catalog.session import Catalog
from shared.jobs import Job
from shared.jobs.leases import get_lease_token, lock_leased_jobs

PROGRESS_INTERVAL_SECONDS = 0.5  # between two notes of the progress


class EvaluationProgress:
    """Counts the questions of one claimed job."""

    def __init__(self, catalog: Catalog, job: Job, stop: threading.Event) -> None:
        self._catalog = catalog
        self._job = job
        self._stop = stop
        self._count = 0
        self._reported = time.monotonic()

    def set_total(self, total: int) -> None:
        """So many there will be, about."""
        self._write_progress(total)

    def advance(self) -> None:
        """One more; Stopped when the job is no longer ours, or its steward is to end."""
        self._count += 1
        if self._stop.is_set():
            raise JobInterrupted
        if time.monotonic() - self._reported > PROGRESS_INTERVAL_SECONDS:
            self._reported = time.monotonic()
            self._write_progress()

    def _write_progress(self, total: int | None = None) -> None:
        with self._catalog.write() as session:
            mine = lock_leased_jobs(session, get_lease_token(self._job), [self._job])
            for current in mine:
                current.progress_total = max(1, total or current.progress_total)
                current.progress_done = min(self._count, current.progress_total)
        if not mine:
            raise JobInterrupted
