"""Taking the steward's own jobs: one at a time, under a lease, whatever it comes to."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass

from sqlalchemy.exc import SQLAlchemyError

from services.steward.metrics import StewardMetrics
from shared.catalog.database_errors import OutageLog
from shared.catalog.session import Catalog
from shared.config.settings import Settings
from shared.errors import PlacewiseError, Unavailable
from shared.jobs import Job, JobKind, claim_jobs, maintain_lease
from shared.jobs.leases import get_lease_token, handle_worker_crash, lock_leased_jobs
from shared.jobs.trace_context import job_trace_context
from shared.jobs.transitions import cancel_batch_items, fail_job, release_job

log = logging.getLogger(__name__)

IDLE_POLL_SECONDS = 0.5
UNAVAILABLE_RETRY_SECONDS = (
    2.0  # pause of a job when the object store, the search tier or the catalog is away
)


class JobInterrupted(Exception):
    """The job was cancelled, or its steward is to end."""


@dataclass(frozen=True, slots=True)
class JobRunner:
    """Takes jobs of some kinds; `do` does one, or a slice of it, and ends or releases it itself."""

    catalog: Catalog
    settings: Settings
    name: str
    kinds: tuple[JobKind, ...]
    metrics: StewardMetrics

    def run(self, stop: threading.Event, do: Callable[[Job], None]) -> None:
        """Take jobs until `stop` is set."""
        outage = OutageLog(f"steward's {' and '.join(self.kinds)} worker")
        while not stop.is_set():
            try:
                done = self.run_next(do)
                outage.record_success()
                if not done:
                    stop.wait(IDLE_POLL_SECONDS)
            except SQLAlchemyError as error:
                outage.record_error(error)
                stop.wait(UNAVAILABLE_RETRY_SECONDS)

    def run_next(self, do: Callable[[Job], None]) -> bool:
        """Do the next job; False when there is none."""
        lease_seconds = self.settings.lease_seconds
        with self.catalog.write() as session:
            jobs = claim_jobs(
                session, worker=self.name, limit=1, lease_seconds=lease_seconds, kinds=self.kinds
            )
        if not jobs:
            return False
        job = jobs[0]
        outcome = "done"
        with (
            maintain_lease(self.catalog, get_lease_token(job), lease_seconds),
            job_trace_context(jobs, job.kind),
        ):
            try:
                do(job)
            except JobInterrupted:
                outcome = "stopped"
                self._finish_claimed(job, release_job)
            except (Unavailable, OSError, SQLAlchemyError) as error:
                outcome = "paused"
                log.warning("the job %s (%s) pauses: %s", job.id, job.kind, error)
                self._finish_claimed(
                    job, lambda mine: release_job(mine, after_seconds=UNAVAILABLE_RETRY_SECONDS)
                )
            except PlacewiseError as error:
                outcome = "failed"
                self._fail(job, error)
            except Exception as error:
                outcome = "crashed"
                log.exception("the job %s (%s) crashed", job.id, job.kind)
                self._record_crash(job, error)
            log.info("a step of %s: %s", job.kind, outcome, extra={"job_id": str(job.id)})
        self.metrics.count_job(job.kind, outcome)
        return True

    def _finish_claimed(self, job: Job, how: Callable[[Job], None]) -> None:
        with self.catalog.write() as session:
            for mine in lock_leased_jobs(session, get_lease_token(job), [job]):
                how(mine)

    def _fail(self, job: Job, error: PlacewiseError) -> None:
        with self.catalog.write() as session:
            for mine in lock_leased_jobs(session, get_lease_token(job), [job]):
                fail_job(mine, error.as_problem())
                cancel_batch_items(session, mine)

    def _record_crash(self, job: Job, error: Exception) -> None:
        with self.catalog.write() as session:
            for mine in lock_leased_jobs(session, get_lease_token(job), [job]):
                handle_worker_crash(
                    session, mine, self.settings.max_attempts, cause=type(error).__name__
                )
