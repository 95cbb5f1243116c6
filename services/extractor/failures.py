"""What becomes of claimed jobs whose batch came to nothing: each is written to them, under their
lease, and raised is only what can't be written.
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

UNAVAILABLE_RETRY_SECONDS = (
    2.0  # pause of jobs when the store or the catalog is not there right now
)
REFUSED_RETRY_SECONDS = 15.0  # pause of photos that need an operator first (weights missing, say)


class JobFailureHandler:
    """Writes them to the jobs of a batch: `jobs` were claimed together, under one token."""

    def __init__(self, catalog: Catalog, max_attempts: int, metrics: ExtractorMetrics) -> None:
        """`max_attempts`: so many falls of a worker over a job alone, and it fails."""
        self._metrics = metrics
        self._catalog = catalog
        self._max_attempts = max_attempts

    @contextlib.contextmanager
    def handling_failures(self, jobs: list[Job], result: DrainStats) -> Iterator[None]:
        """What goes wrong in the block is written to the jobs, and failed ones are counted."""
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
        """Photos wait until the map has one; a query is told at once."""
        self._metrics.count_outcome(JobKind(jobs[0].kind), "waiting", len(jobs))
        with self._catalog.write() as session:
            lock_map(session, jobs[0].map_id)
            there = active_generation(session, jobs[0].map_id) is not None
            for job in lock_leased_jobs(session, get_lease_token(jobs[0]), jobs):
                if job.kind == JobKind.DESCRIBE and not there:
                    fail_job(job, no_vocabulary_error().as_problem())
                else:
                    release_job(job, waiting_for=None if there else WaitingFor.VOCABULARY)

    def release_unstarted(self, jobs: list[Job]) -> None:
        """Stopping: what was taken ahead goes to another worker, unharmed."""
        self._metrics.count_outcome(JobKind(jobs[0].kind), "given_back", len(jobs))
        with self._catalog.write() as session:
            for job in lock_leased_jobs(session, get_lease_token(jobs[0]), jobs):
                release_job(job)

    def _retry_later(self, jobs: list[Job], error: Exception) -> None:
        """Something outside the jobs is away: try again soon, and count no attempt."""
        log.warning("%d jobs pause for %g s: %s", len(jobs), UNAVAILABLE_RETRY_SECONDS, error)
        with self._catalog.write() as session:
            for job in lock_leased_jobs(session, get_lease_token(jobs[0]), jobs):
                release_job(job, after_seconds=UNAVAILABLE_RETRY_SECONDS)
                job.error = error.as_problem() if isinstance(error, PlacewiseError) else None

    def _fail_or_defer(self, jobs: list[Job], error: PlacewiseError) -> int:
        """The request can't be met. Stored photos wait for the operator, all else fails."""
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
        """As if the worker had died: what fell in a batch is tried alone, then counted."""
        with self._catalog.write() as session:
            for job in lock_leased_jobs(session, get_lease_token(jobs[0]), jobs):
                job.claimed_together = len(jobs)
                handle_worker_crash(session, job, self._max_attempts, cause=type(error).__name__)


def no_vocabulary_error() -> Conflict:
    return Conflict(
        "no_vocabulary",
        "The map's extractor needs a vocabulary and the map has none yet. Fit one on its photos "
        "(POST /api/v1/vocabularies) or import one (POST /api/v1/vocabularies/import).",
    )
