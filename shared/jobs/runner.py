"""Job runner: claims jobs, renews their lease, and decides what happens when a job fails.

The extractor and the steward run their jobs through it, so this is the one place where a job is
requeued after an error of its worker (`retry_job` is the manual way):

| failure | what happens to the job |
|---|---|
| dependency unavailable (`Unavailable`, `OSError`, database) | requeued, every 2 s without limit |
| `PlacewiseError` that stops `index` or `reindex` jobs | requeued, every 15 s without limit |
| `PlacewiseError` that stops other jobs | failed with the error |
| one photo of a batch can't be described | not handled here: `publish` fails its job |
| lease lost, or the worker stops (`JobInterrupted`) | requeued |
| other exception, or the worker died | requeued to run alone, then failed after MAX_ATTEMPTS |

A `PlacewiseError` stops the step of a whole batch of `index` or `reindex` jobs if, say, weights are
missing. The jobs store the error and are retried, because an operator can remove the cause. Jobs
that `publish` has failed are not retried. Only the last row counts attempts.

A worker that raises updates its own jobs. The jobs of a worker that died are found by
`reclaim_expired_leases` once their lease has expired.
"""

from __future__ import annotations

import contextlib
import logging
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, TypeVar
from uuid import UUID

from sqlalchemy import select
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from shared.catalog.batch_items import has_batch_items
from shared.catalog.database.base import count_rows, db_now
from shared.catalog.database.errors import OutageLog
from shared.catalog.database.session import IDLE_SECONDS, Catalog, ChangePoll
from shared.catalog.jobs import UNFINISHED_STATES, Job, JobKind, JobState, claimable_condition
from shared.config.settings import Settings
from shared.errors import PlacewiseError, Unavailable
from shared.jobs.claim import claim_conditions, claim_jobs
from shared.jobs.leases import get_lease_token, lock_leased_jobs, maintain_lease
from shared.jobs.model_changes import abandon_generation
from shared.jobs.transitions import cancel_batch_items, fail_job, requeue_job
from shared.jobs.wakeups import Wakeups, read_job_messages, report_jobs
from shared.telemetry.request_ids import request_id_context

log = logging.getLogger(__name__)

MAX_ATTEMPTS = 3  # crashes of a job that runs alone, before it fails
IDLE_POLL_SECONDS = 0.5  # the delay that a lost wakeup costs
UNAVAILABLE_RETRY_SECONDS = 2.0  # while the store, the search tier or the catalog is unavailable
REFUSED_RETRY_SECONDS = 15.0  # retry delay of photos that need an operator (say, missing weights)

Result = TypeVar("Result")


class JobInterrupted(Exception):
    """The job lost its lease (cancelled or taken over), or the worker is shutting down."""


class StepOutcome(StrEnum):
    """How a step of claimed jobs ended."""

    DONE = "done"
    INTERRUPTED = "requeued"
    PAUSED = "paused"
    FAILED = "failed"
    CRASHED = "crashed"


@dataclass(slots=True)
class ClaimedJobs:
    """Jobs claimed under one token, and the lease that is renewed until it is closed."""

    jobs: list[Job]
    lease: contextlib.ExitStack
    reasons: Counter[str] = field(default_factory=Counter)
    """Number of jobs that failed, by the code of the error."""

    @property
    def token(self) -> UUID:
        return get_lease_token(self.jobs[0])

    @property
    def kind(self) -> JobKind:
        return JobKind(self.jobs[0].kind)


@dataclass
class JobRunner:
    """Runs the jobs of one worker.

    Attributes:
        catalog: The catalog.
        settings: LEASE_SECONDS.
        worker: Name of the worker, stored with its jobs.
        kinds: Kinds of jobs that the worker runs.
        on_outcome: Called with kind, outcome and number of jobs after each step, for metrics.
        wakeups: Tells monitors what becomes of the jobs.
    """

    catalog: Catalog
    settings: Settings
    worker: str
    kinds: Sequence[JobKind]
    on_outcome: Callable[[JobKind, StepOutcome, int], object]
    wakeups: Wakeups | None = None

    def __post_init__(self) -> None:
        self._outage = OutageLog(f"worker {self.worker}")

    def run(
        self,
        work: Callable[[], bool],
        stop: threading.Event,
        wait: Callable[[float], object],
    ) -> None:
        """Repeat `work`, which returns whether there were jobs, until `stop` is set.

        Without jobs, `wait` waits for new ones, at most the given seconds: long in an embedded
        server without any job, because nothing but a commit that it hears of can bring one.
        """
        while not stop.is_set():
            if self.run_once(work, stop) is False:
                is_idle = self.catalog.is_sqlite and self.run_once(self._has_none_unfinished, stop)
                wait(IDLE_SECONDS if is_idle else IDLE_POLL_SECONDS)

    def _has_none_unfinished(self) -> bool:
        """Return whether no job can become claimable by the passing of time."""
        unfinished = select(Job.id).where(
            Job.state.in_(UNFINISHED_STATES), Job.kind.in_(self.kinds), Job.waiting_for.is_(None)
        )
        with self.catalog.read() as session:
            return session.scalar(unfinished.limit(1)) is None

    def run_jobs(self, handler: Callable[[Job], None], stop: threading.Event) -> None:
        """Run jobs one after the other with `handler` (see `run_next`) until `stop` is set."""
        poll = ChangePoll(self.catalog)
        self.run(
            lambda: self.run_next(handler),
            stop,
            lambda seconds: poll.wait(stop, IDLE_POLL_SECONDS, seconds),
        )

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

        The handler completes the job or requeues it for its next slice. Returns False if there
        was no job.
        """
        claimed = self.claim() if self.has_jobs() else None  # most looks find none
        if claimed is None:
            return False
        job = claimed.jobs[0]
        self.report_started(claimed)
        with claimed.lease, self.step(claimed):
            handler(job)
            log.info("step of %s job: done", job.kind, extra={"job_id": str(job.id)})
        self.report_ended(claimed)
        return True

    def report_started(self, claimed: ClaimedJobs) -> None:
        """Tell monitors that the jobs run."""
        if self.wakeups is not None:
            self.wakeups.started(*claimed.jobs)

    def report_ended(self, claimed: ClaimedJobs) -> None:
        """Tell monitors what has become of the jobs."""
        if self.wakeups is not None:
            with contextlib.suppress(SQLAlchemyError):  # what is told is committed already
                report_jobs(self.catalog, self.wakeups, [job.id for job in claimed.jobs])

    def has_jobs(self, min_priority: int | None = None, *, alone: bool = True) -> bool:
        """Return whether `claim` with the same arguments would find a job."""
        found = select(Job.id).where(*claim_conditions(self.kinds, min_priority, alone)).limit(1)
        with self.catalog.read_once() as session:
            return session.scalar(found) is not None

    def count_waiting(self, limit: int) -> int:
        """Count the jobs that `claim` could claim, up to `limit`."""
        waiting = select(Job.id).where(claimable_condition(self.kinds))
        with self.catalog.read_once() as session:
            return count_rows(session, waiting, limit)

    def claim(
        self,
        limit: int = 1,
        min_priority: int | None = None,
        *,
        alone: bool = True,
        started: bool = True,
    ) -> ClaimedJobs | None:
        """Claim jobs and begin to renew their lease; see `claim_jobs`. None if there are none."""
        lease_seconds = self.settings.lease_seconds
        with self.catalog.write() as session:
            jobs = claim_jobs(
                session,
                worker=self.worker,
                limit=limit,
                lease_seconds=lease_seconds,
                kinds=self.kinds,
                min_priority=min_priority,
                alone=alone,
                started=started,
            )
            ids = [job.id for job in jobs]
            messages = read_job_messages(session, ids) if self.wakeups and jobs else []
        if not jobs:
            return None
        if self.wakeups is not None:
            self.wakeups.claimed(*messages)
        claimed = ClaimedJobs(jobs, contextlib.ExitStack())
        claimed.lease.enter_context(maintain_lease(self.catalog, claimed.token, lease_seconds))
        return claimed

    def requeue(self, claimed: ClaimedJobs) -> None:
        """Return the jobs to the queue because the worker stops, without counting an attempt."""
        self._update(claimed, lambda _session, job: requeue_job(job))
        self.on_outcome(claimed.kind, StepOutcome.INTERRUPTED, len(claimed.jobs))
        self.report_ended(claimed)

    @contextlib.contextmanager
    def step(self, claimed: ClaimedJobs) -> Iterator[None]:
        """Context manager that handles the exceptions of a step of the jobs.

        The jobs are updated as the module's table says. Only an error of that update is raised.
        When all jobs come from one request, log lines carry its id, and jobs that the block creates
        belong to it.
        """
        outcome, together = StepOutcome.DONE, len(claimed.jobs)
        jobs = f"{together} {claimed.kind} jobs (first: {claimed.jobs[0].id})"
        ids = distinct_request_ids(claimed.jobs)
        with request_id_context(ids[0] if len(ids) == 1 else None):
            try:
                yield
            except JobInterrupted:
                outcome = StepOutcome.INTERRUPTED
                log.info("%s: interrupted", jobs)
                self._update(claimed, lambda _session, job: requeue_job(job))
            except (Unavailable, OSError, SQLAlchemyError) as error:
                outcome, delay = StepOutcome.PAUSED, UNAVAILABLE_RETRY_SECONDS
                log.warning("%s: retried in %g s: %s", jobs, delay, error)
                problem = error.as_problem() if isinstance(error, PlacewiseError) else None
                self._update(
                    claimed,
                    lambda _session, job: requeue_job(job, after_seconds=delay, problem=problem),
                )
            except PlacewiseError as error:
                outcome, refusal = StepOutcome.FAILED, error.as_problem()
                log.error("%s: %s: %s", jobs, error.code, error.detail)
                updated = self._update(
                    claimed, lambda session, job: _fail_or_requeue(session, job, refusal)
                )
                failed = sum(job.state == JobState.FAILED for job in updated)
                claimed.reasons[error.code] += failed
            except Exception as error:
                outcome, event = StepOutcome.CRASHED, f"crashed ({type(error).__name__})"
                log.exception("%s: crashed", jobs)
                self._update(
                    claimed,
                    lambda session, job: _requeue_after_crash(session, job, together, event),
                )
            self.on_outcome(claimed.kind, outcome, together)

    def _update(
        self, claimed: ClaimedJobs, transition: Callable[[Session, Job], None]
    ) -> list[Job]:
        """Apply the transition to the jobs that are still under the lease, and return them."""
        with self.catalog.write() as session:
            jobs = lock_leased_jobs(session, claimed.token, claimed.jobs)
            for job in jobs:
                transition(session, job)
        return jobs


def reclaim_expired_leases(session: Session, *, all_leases: bool = False) -> list[Job]:
    """Return the jobs of dead workers to the queue, or fail them after MAX_ATTEMPTS.

    Args:
        session: The session of a write transaction.
        all_leases: Reclaim also leases that have not expired, for a process that knows that no
            other worker runs.

    Returns:
        The jobs that were reclaimed.
    """
    expired = select(Job).where(Job.lease_token.is_not(None))
    if not all_leases:
        expired = expired.where(Job.lease_until < db_now())
    jobs = session.scalars(expired.order_by(Job.id).with_for_update(skip_locked=True)).all()
    for job in jobs:
        _requeue_after_crash(session, job, job.claimed_together, "died")
    return list(jobs)


def _requeue_after_crash(session: Session, job: Job, together: int, event: str) -> None:
    """Requeue or fail a job whose worker died or raised an exception (`event`).

    A job that ran `together` with others is requeued to run alone, without counting an attempt, to
    isolate the job that crashed the worker. A job that ran alone fails after MAX_ATTEMPTS. A job
    that had not started (0) can't be the cause.
    """
    job.attempts += together == 1
    # An upload batch continues without the photo that may be the cause: see BatchWorker.
    if together == 1 and job.attempts >= MAX_ATTEMPTS and not has_batch_items(job):
        error = PlacewiseError(
            "worker_crashed",
            f"The worker {job.worker} {event} {job.attempts} times while it ran only this job. "
            "If the photo is valid, check the worker's log and memory, then retry the job.",
        )
        _fail_for_good(session, job, error.as_problem())
        return
    job.alone = job.alone or together > 1
    requeue_job(job)


def _fail_or_requeue(session: Session, job: Job, problem: dict[str, Any]) -> None:
    """Fail the job; a stored photo is requeued, because an operator can remove the cause."""
    if job.kind in (JobKind.INDEX, JobKind.REINDEX):
        requeue_job(job, after_seconds=REFUSED_RETRY_SECONDS, problem=problem)
    else:
        _fail_for_good(session, job, problem)


def _fail_for_good(session: Session, job: Job, problem: dict[str, Any]) -> None:
    """Fail the job, and end what depends on it: its generation, or the items of its batch."""
    fail_job(job, problem)
    abandon_generation(session, job)
    cancel_batch_items(session, job)


def distinct_request_ids(jobs: Sequence[Job]) -> list[str]:
    """Return each request id once, in the jobs' order; a job without a request adds none."""
    return list(dict.fromkeys(job.request_id for job in jobs if job.request_id is not None))
