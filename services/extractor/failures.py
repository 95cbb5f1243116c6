"""Failure handling of claimed jobs: retries, deferral and permanent failure.

Each outcome is written to the jobs under their lease; only errors of that write are raised.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator

from sqlalchemy.exc import SQLAlchemyError

from services.extractor.metrics import DrainStats, ExtractorMetrics
from shared.catalog.generations import active_generation
from shared.catalog.jobs import JobKind, WaitingFor
from shared.catalog.maps import lock_map
from shared.catalog.session import Catalog
from shared.errors import Conflict, PlacewiseError, Unavailable
from shared.jobs import Job
from shared.jobs.leases import get_lease_token, handle_worker_crash, lock_leased_jobs
from shared.jobs.model_changes import abandon_generation
from shared.jobs.transitions import fail_job, release_job

log = logging.getLogger(__name__)

UNAVAILABLE_RETRY_SECONDS = 2.0  # retry delay when the store or the catalog is unavailable
REFUSED_RETRY_SECONDS = 15.0  # retry delay of photos that need an operator (say, missing weights)


class JobFailureHandler:
    """Writes failures to the jobs of a batch, which were claimed together under one lease token."""

    def __init__(self, catalog: Catalog, max_attempts: int, metrics: ExtractorMetrics) -> None:
        """Create a handler.

        Args:
            catalog: The catalog.
            max_attempts: Crashes of a worker on a job alone after which the job fails.
            metrics: Counts the outcomes.
        """
        self._metrics = metrics
        self._catalog = catalog
        self._max_attempts = max_attempts

    @contextlib.contextmanager
    def handling_failures(self, jobs: list[Job], result: DrainStats) -> Iterator[None]:
        """Handle the block's exceptions by updating the jobs; count failed ones in `result`."""
        kind = JobKind(jobs[0].kind)
        try:
            yield
        except (Unavailable, OSError, SQLAlchemyError) as error:
            self._metrics.count_outcome(kind, "paused", len(jobs))
            self._retry_later(jobs, error)
        except PlacewiseError as error:
            self._metrics.count_outcome(kind, "refused", len(jobs))
            result.failed += self._fail_or_defer(jobs, error)
        except Exception as error:
            log.exception("a batch of %d jobs crashed", len(jobs))
            self._metrics.count_outcome(kind, "crashed", len(jobs))
            self._record_crash(jobs, error)

    def defer_until_vocabulary(self, jobs: list[Job]) -> None:
        """Requeue photos until the map has a vocabulary; fail queries."""
        self._metrics.count_outcome(JobKind(jobs[0].kind), "waiting", len(jobs))
        with self._catalog.write() as session:
            lock_map(session, jobs[0].map_id)
            has_generation = active_generation(session, jobs[0].map_id) is not None
            for job in lock_leased_jobs(session, get_lease_token(jobs[0]), jobs):
                if job.kind == JobKind.DESCRIBE and not has_generation:
                    fail_job(job, no_vocabulary_error().as_problem())
                else:
                    release_job(job, waiting_for=None if has_generation else WaitingFor.VOCABULARY)

    def release_unstarted(self, jobs: list[Job]) -> None:
        """Return claimed jobs that have not started to the queue, without counting an attempt."""
        self._metrics.count_outcome(JobKind(jobs[0].kind), "given_back", len(jobs))
        with self._catalog.write() as session:
            for job in lock_leased_jobs(session, get_lease_token(jobs[0]), jobs):
                release_job(job)

    def _retry_later(self, jobs: list[Job], error: Exception) -> None:
        """Requeue jobs after a transient failure outside them, without counting an attempt."""
        log.warning("%d jobs retried in %g s: %s", len(jobs), UNAVAILABLE_RETRY_SECONDS, error)
        with self._catalog.write() as session:
            for job in lock_leased_jobs(session, get_lease_token(jobs[0]), jobs):
                release_job(job, after_seconds=UNAVAILABLE_RETRY_SECONDS)
                job.error = error.as_problem() if isinstance(error, PlacewiseError) else None

    def _fail_or_defer(self, jobs: list[Job], error: PlacewiseError) -> int:
        """Fail the jobs, except stored photos, which are retried once an operator has acted."""
        log.error("%s", error.detail)
        failed = 0
        with self._catalog.write() as session:
            for job in lock_leased_jobs(session, get_lease_token(jobs[0]), jobs):
                if job.kind in (JobKind.INDEX, JobKind.REINDEX):
                    release_job(job, after_seconds=REFUSED_RETRY_SECONDS)
                    job.error = error.as_problem()
                    continue
                fail_job(job, error.as_problem())
                failed += 1
                abandon_generation(session, job)
        return failed

    def _record_crash(self, jobs: list[Job], error: Exception) -> None:
        """Handle an unexpected exception like a crash of the worker.

        Jobs of a batch are retried alone; only a crash on a job alone counts as an attempt.
        """
        with self._catalog.write() as session:
            for job in lock_leased_jobs(session, get_lease_token(jobs[0]), jobs):
                job.claimed_together = len(jobs)
                handle_worker_crash(session, job, self._max_attempts, cause=type(error).__name__)


def no_vocabulary_error() -> Conflict:
    """Error for a query to a map whose extractor needs a vocabulary that it does not have."""
    return Conflict(
        "no_vocabulary",
        "The map's extractor needs a vocabulary, but the map has none yet. Fit one on its photos "
        "(POST /api/v1/vocabularies) or import one (POST /api/v1/vocabularies/import).",
    )
