"""Runs the steward's own jobs (batches, evaluations) one at a time, under a lease.

A job whose dependency is unavailable is released and retried; a job that raises a Placewise error
fails; a crash counts as an attempt.
"""

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
# Pause of a job while the object store, the search tier or the catalog is unavailable.
UNAVAILABLE_RETRY_SECONDS = 2.0


class JobInterrupted(Exception):
    """The job lost its lease (cancelled or taken over), or the steward is shutting down."""


@dataclass(frozen=True, slots=True)
class JobRunner:
    """Claims jobs of the given kinds and passes each to a handler.

    The handler runs the job or a slice of it, and completes or releases it itself.
    """

    catalog: Catalog
    settings: Settings
    name: str
    kinds: tuple[JobKind, ...]
    metrics: StewardMetrics

    def run(self, stop: threading.Event, handler: Callable[[Job], None]) -> None:
        """Run jobs until `stop` is set."""
        outage = OutageLog(f"steward's {' and '.join(self.kinds)} worker")
        while not stop.is_set():
            try:
                has_run = self.run_next(handler)
                outage.record_success()
                if not has_run:
                    stop.wait(IDLE_POLL_SECONDS)
            except SQLAlchemyError as error:
                outage.record_error(error)
                stop.wait(UNAVAILABLE_RETRY_SECONDS)

    def run_next(self, handler: Callable[[Job], None]) -> bool:
        """Run the next job, or a slice of it; False when there is none."""
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
                handler(job)
            except JobInterrupted:
                outcome = "stopped"
                self._finish_claimed(job, release_job)
            except (Unavailable, OSError, SQLAlchemyError) as error:
                outcome = "paused"
                log.warning("job %s (%s) is paused: %s", job.id, job.kind, error)
                self._finish_claimed(
                    job, lambda leased: release_job(leased, after_seconds=UNAVAILABLE_RETRY_SECONDS)
                )
            except PlacewiseError as error:
                outcome = "failed"
                self._fail(job, error)
            except Exception as error:
                outcome = "crashed"
                log.exception("job %s (%s) crashed", job.id, job.kind)
                self._record_crash(job, error)
            log.info("step of %s job: %s", job.kind, outcome, extra={"job_id": str(job.id)})
        self.metrics.count_job(job.kind, outcome)
        return True

    def _finish_claimed(self, job: Job, transition: Callable[[Job], None]) -> None:
        with self.catalog.write() as session:
            for leased in lock_leased_jobs(session, get_lease_token(job), [job]):
                transition(leased)

    def _fail(self, job: Job, error: PlacewiseError) -> None:
        with self.catalog.write() as session:
            for leased in lock_leased_jobs(session, get_lease_token(job), [job]):
                fail_job(leased, error.as_problem())
                cancel_batch_items(session, leased)

    def _record_crash(self, job: Job, error: Exception) -> None:
        with self.catalog.write() as session:
            for leased in lock_leased_jobs(session, get_lease_token(job), [job]):
                handle_worker_crash(
                    session, leased, self.settings.max_attempts, cause=type(error).__name__
                )
