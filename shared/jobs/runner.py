"""Job runner: claims jobs, renews their lease, and decides what happens when a job fails.

The extractor and the steward run their jobs through it, so this is the one place where a job is
retried:

| failure | what happens to the job |
|---|---|
| dependency unavailable (`Unavailable`, `OSError`, database) | requeued; no attempt is counted |
| `PlacewiseError` on a stored photo | requeued with the error, until an operator has acted |
| `PlacewiseError` on any other job | failed with the error |
| lease lost, or the worker stops (`JobInterrupted`) | requeued; no attempt is counted |
| other exception, or the worker died | retried alone, then failed after MAX_ATTEMPTS |

A worker that raises updates its own jobs. The jobs of a worker that died are found by
`reclaim_expired_leases` once their lease has expired.
"""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, TypeVar
from uuid import UUID

from sqlalchemy import select
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from shared.catalog.base import db_now
from shared.catalog.batch_items import has_batch_items
from shared.catalog.database_errors import OutageLog
from shared.catalog.jobs import Job, JobKind
from shared.catalog.session import Catalog
from shared.config.settings import Settings
from shared.errors import PlacewiseError, Unavailable
from shared.jobs.claim import claim_jobs, has_claimable_jobs
from shared.jobs.leases import get_lease_token, lock_leased_jobs, maintain_lease
from shared.jobs.model_changes import abandon_generation
from shared.jobs.trace_context import job_trace_context
from shared.jobs.transitions import cancel_batch_items, fail_job, release_job

log = logging.getLogger(__name__)

IDLE_POLL_SECONDS = 0.5  # the delay that a lost wakeup costs
UNAVAILABLE_RETRY_SECONDS = 2.0  # while the store, the search tier or the catalog is unavailable
REFUSED_RETRY_SECONDS = 15.0  # retry delay of photos that need an operator (say, missing weights)

Result = TypeVar("Result")


class JobInterrupted(Exception):
    """The job lost its lease (cancelled or taken over), or the worker is shutting down."""


class StepOutcome(StrEnum):
    """How a step of claimed jobs ended."""

    DONE = "done"
    INTERRUPTED = "stopped"
    PAUSED = "paused"
    FAILED = "failed"
    CRASHED = "crashed"


@dataclass(slots=True)
class ClaimedJobs:
    """Jobs claimed under one token, and the lease that is renewed until it is closed."""

    jobs: list[Job]
    lease: contextlib.ExitStack

    @property
    def token(self) -> UUID:
        return get_lease_token(self.jobs[0])

    @property
    def kind(self) -> JobKind:
        return JobKind(self.jobs[0].kind)


@dataclass(slots=True)
class JobStep:
    """Outcome of a step, set when it has ended."""

    outcome: StepOutcome = StepOutcome.DONE
    failed: int = 0
    """Number of jobs that have failed for good."""


class JobRunner:
    """Runs the jobs of one worker.

    Args:
        catalog: The catalog.
        settings: LEASE_SECONDS and MAX_ATTEMPTS.
        worker: Name of the worker, stored with its jobs.
        kinds: Kinds of jobs that the worker runs.
        on_outcome: Called with kind, outcome and number of jobs after each step, for metrics.
    """

    def __init__(
        self,
        catalog: Catalog,
        settings: Settings,
        worker: str,
        kinds: Sequence[JobKind],
        on_outcome: Callable[[JobKind, StepOutcome, int], object],
    ) -> None:
        self._catalog = catalog
        self._settings = settings
        self._worker = worker
        self._kinds = kinds
        self._on_outcome = on_outcome
        self._outage = OutageLog(f"worker {worker}")

    def run(
        self,
        work: Callable[[], bool],
        stop: threading.Event,
        wait: Callable[[], object] | None = None,
    ) -> None:
        """Repeat `work` until `stop` is set.

        Args:
            work: Runs jobs; returns False when there were none.
            stop: Ends the loop once `work` has returned.
            wait: Waits for new jobs; by default for IDLE_POLL_SECONDS, or until `stop` is set.
        """
        while not stop.is_set():
            if self.run_once(work, stop) is False:
                wait() if wait is not None else stop.wait(IDLE_POLL_SECONDS)

    def run_once(self, work: Callable[[], Result], stop: threading.Event) -> Result | None:
        """Run `work`; pause and return None if the catalog was unavailable.

        Jobs that are still claimed then are requeued when their lease expires.
        """
        try:
            result = work()
        except SQLAlchemyError as error:
            self._outage.record_error(error)
            stop.wait(UNAVAILABLE_RETRY_SECONDS)
            return None
        self._outage.record_success()
        return result

    def run_next(self, handler: Callable[[Job], None]) -> bool:
        """Claim the next job and run it, or a slice of it, with `handler`.

        The handler completes the job or releases it until its next slice. Returns False if there
        was no job.
        """
        claimed = self.claim()
        if claimed is None:
            return False
        job = claimed.jobs[0]
        with claimed.lease, self.step(claimed, job.kind):
            handler(job)
            log.info("step of %s job: done", job.kind, extra={"job_id": str(job.id)})
        return True

    def has_jobs(self, min_priority: int | None = None, *, alone: bool = True) -> bool:
        """Return whether `claim` with the same arguments would find a job."""
        with self._catalog.read() as session:
            return has_claimable_jobs(session, self._kinds, min_priority, alone=alone)

    def claim(
        self,
        limit: int = 1,
        min_priority: int | None = None,
        *,
        alone: bool = True,
        started: bool = True,
    ) -> ClaimedJobs | None:
        """Claim jobs and begin to renew their lease; see `claim_jobs`. None if there are none."""
        lease_seconds = self._settings.lease_seconds
        with self._catalog.write() as session:
            jobs = claim_jobs(
                session,
                worker=self._worker,
                limit=limit,
                lease_seconds=lease_seconds,
                kinds=self._kinds,
                min_priority=min_priority,
                alone=alone,
                started=started,
            )
        if not jobs:
            return None
        claimed = ClaimedJobs(jobs, contextlib.ExitStack())
        claimed.lease.enter_context(maintain_lease(self._catalog, claimed.token, lease_seconds))
        return claimed

    def release(self, claimed: ClaimedJobs) -> None:
        """Return the jobs to the queue because the worker stops, without counting an attempt."""
        self._update(claimed, release_job)
        self._on_outcome(claimed.kind, StepOutcome.INTERRUPTED, len(claimed.jobs))

    @contextlib.contextmanager
    def step(self, claimed: ClaimedJobs, name: str) -> Iterator[JobStep]:
        """Context manager that traces a step of the jobs and handles its exceptions.

        The jobs are updated as the module's table says. Only an error of that update is raised.
        """
        step = JobStep()
        jobs = f"{len(claimed.jobs)} {claimed.kind} jobs (first: {claimed.jobs[0].id})"
        with job_trace_context(claimed.jobs, name):
            try:
                yield step
            except JobInterrupted:
                step.outcome = StepOutcome.INTERRUPTED
                log.info("%s: interrupted", jobs)
                self._update(claimed, release_job)
            except (Unavailable, OSError, SQLAlchemyError) as error:
                step.outcome = StepOutcome.PAUSED
                log.warning("%s: retried in %g s: %s", jobs, UNAVAILABLE_RETRY_SECONDS, error)
                problem = error.as_problem() if isinstance(error, PlacewiseError) else None
                self._update(
                    claimed,
                    lambda job: release_job(
                        job, after_seconds=UNAVAILABLE_RETRY_SECONDS, problem=problem
                    ),
                )
            except PlacewiseError as error:
                step.outcome = StepOutcome.FAILED
                log.error("%s: %s", jobs, error.detail)
                step.failed = self._fail_or_defer(claimed, error.as_problem())
            except Exception as error:
                step.outcome = StepOutcome.CRASHED
                log.exception("%s: crashed", jobs)
                self._record_crash(claimed, type(error).__name__)
            self._on_outcome(claimed.kind, step.outcome, len(claimed.jobs))

    def _update(self, claimed: ClaimedJobs, transition: Callable[[Job], None]) -> None:
        with self._catalog.write() as session:
            for job in lock_leased_jobs(session, claimed.token, claimed.jobs):
                transition(job)

    def _fail_or_defer(self, claimed: ClaimedJobs, problem: dict[str, Any]) -> int:
        """Fail the jobs, except stored photos; return the number of failed ones."""
        failed = 0
        with self._catalog.write() as session:
            for job in lock_leased_jobs(session, claimed.token, claimed.jobs):
                if job.kind in (JobKind.INDEX, JobKind.REINDEX):
                    release_job(job, after_seconds=REFUSED_RETRY_SECONDS, problem=problem)
                else:
                    _fail_for_good(session, job, problem)
                    failed += 1
        return failed

    def _record_crash(self, claimed: ClaimedJobs, cause: str) -> None:
        with self._catalog.write() as session:
            for job in lock_leased_jobs(session, claimed.token, claimed.jobs):
                job.claimed_together = len(claimed.jobs)
                _retry_after_crash(session, job, self._settings.max_attempts, cause)


def reclaim_expired_leases(session: Session, max_attempts: int, *, all_leases: bool = False) -> int:
    """Return the jobs of dead workers to the queue, or fail them after `max_attempts`.

    Args:
        session: The session of a write transaction.
        max_attempts: Number of crashes after which a job that ran alone fails. A job that was in a
            batch of several is marked `alone` instead, because another one may be the cause.
        all_leases: Reclaim also leases that have not expired, for a process that knows that no
            other worker runs.

    Returns:
        The number of jobs reclaimed.
    """
    expired = select(Job).where(Job.lease_token.is_not(None))
    if not all_leases:
        expired = expired.where(Job.lease_until < db_now())
    jobs = session.scalars(expired.order_by(Job.id).with_for_update(skip_locked=True)).all()
    for job in jobs:
        _retry_after_crash(session, job, max_attempts, cause=None)
    return len(jobs)


def _retry_after_crash(session: Session, job: Job, max_attempts: int, cause: str | None) -> None:
    """Retry or fail a job whose worker died (`cause` is None) or raised an exception (its name).

    A job that was in a batch of several is retried alone without counting an attempt, to isolate
    the job that crashed the worker. A job that ran alone fails after `max_attempts`.
    """
    if job.claimed_together == 0:  # not started: the job can't be the cause
        release_job(job)
        return
    ran_alone = job.claimed_together == 1
    job.attempts += ran_alone
    # An upload batch continues without the photo that may be the cause: see BatchWorker.
    if job.attempts >= max_attempts and not has_batch_items(job):
        _fail_for_good(session, job, _worker_crash_problem(job, cause))
        return
    job.alone = job.alone or not ran_alone
    release_job(job)


def _fail_for_good(session: Session, job: Job, problem: dict[str, Any]) -> None:
    """Fail the job, and end what depends on it: its generation, or the items of its batch."""
    fail_job(job, problem)
    abandon_generation(session, job)
    cancel_batch_items(session, job)


def _worker_crash_problem(job: Job, cause: str | None) -> dict[str, Any]:
    event = f"crashed ({cause})" if cause else "died"
    return {
        "type": "urn:placewise:problem:worker_fell",
        "title": "The worker crashed",
        "status": 500,
        "code": "worker_fell",
        "detail": (
            f"The worker {job.worker} {event} {job.attempts} times while it ran only this job. "
            "If the photo is valid, check the worker's log and memory, then retry the job."
        ),
    }
