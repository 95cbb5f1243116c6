"""What becomes of claimed jobs whose batch came to nothing: each is written to them, under their
lease, and raised is only what can't be written.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator

from sqlalchemy.exc import SQLAlchemyError

from services.extractor.drain_result import DrainResult
from services.extractor.metrics import ExtractorMetrics
from shared.catalog.generations import active_generation
from shared.catalog.maps import lock_map
from shared.catalog.session import Catalog
from shared.errors import Conflict, PlacewiseError, Unavailable
from shared.jobs import Job
from shared.jobs.finish import fail, release
from shared.jobs.leases import fallen, held, token_of
from shared.jobs.model_changes import abandon_generation
from shared.jobs.table import JobKind, WaitingFor

log = logging.getLogger(__name__)

AWAY_SECONDS = 2.0  # pause of jobs when the store or the catalog is not there right now
OPERATOR_SECONDS = 15.0  # pause of photos that need an operator first (weights missing, say)


class Setbacks:
    """Writes them to the jobs of a batch: `jobs` were claimed together, under one token."""

    def __init__(self, catalog: Catalog, max_attempts: int, metrics: ExtractorMetrics) -> None:
        """`max_attempts`: so many falls of a worker over a job alone, and it fails."""
        self._metrics = metrics
        self._catalog = catalog
        self._max_attempts = max_attempts

    @contextlib.contextmanager
    def answered(self, jobs: list[Job], result: DrainResult) -> Iterator[None]:
        """What goes wrong in the block is written to the jobs, and failed ones are counted."""
        kind = JobKind(jobs[0].kind)
        try:
            yield
        except (Unavailable, OSError, SQLAlchemyError) as error:
            self._metrics.ended(kind, "paused", len(jobs))
            self._pause(jobs, error)
        except PlacewiseError as error:
            self._metrics.ended(kind, "refused", len(jobs))
            result.failed += self._refuse(jobs, error)
        except Exception as error:
            log.exception("a batch of %d jobs crashed", len(jobs))
            self._metrics.ended(kind, "crashed", len(jobs))
            self._crashed(jobs, error)

    def wait_for_vocabulary(self, jobs: list[Job]) -> None:
        """Photos wait until the map has one; a query is told at once."""
        self._metrics.ended(JobKind(jobs[0].kind), "waiting", len(jobs))
        with self._catalog.write() as session:
            lock_map(session, jobs[0].map_id)
            there = active_generation(session, jobs[0].map_id) is not None
            for job in held(session, token_of(jobs[0]), jobs):
                if job.kind == JobKind.DESCRIBE and not there:
                    fail(job, no_vocabulary().as_problem())
                else:
                    release(job, waiting_for=None if there else WaitingFor.VOCABULARY)

    def give_back(self, jobs: list[Job]) -> None:
        """Stopping: what was taken ahead goes to another worker, unharmed."""
        self._metrics.ended(JobKind(jobs[0].kind), "given_back", len(jobs))
        with self._catalog.write() as session:
            for job in held(session, token_of(jobs[0]), jobs):
                release(job)

    def _pause(self, jobs: list[Job], error: Exception) -> None:
        """Something outside the jobs is away: try again soon, and count no attempt."""
        log.warning("%d jobs pause for %g s: %s", len(jobs), AWAY_SECONDS, error)
        with self._catalog.write() as session:
            for job in held(session, token_of(jobs[0]), jobs):
                release(job, after_seconds=AWAY_SECONDS)
                job.error = error.as_problem() if isinstance(error, PlacewiseError) else None

    def _refuse(self, jobs: list[Job], error: PlacewiseError) -> int:
        """The request can't be met. Stored photos wait for the operator, all else fails."""
        log.error("%s", error.detail)
        failed = 0
        with self._catalog.write() as session:
            for job in held(session, token_of(jobs[0]), jobs):
                if job.kind in (JobKind.INDEX, JobKind.REINDEX):
                    release(job, after_seconds=OPERATOR_SECONDS)
                    job.error = error.as_problem()
                    continue
                fail(job, error.as_problem())
                failed += 1
                abandon_generation(session, job)
        return failed

    def _crashed(self, jobs: list[Job], error: Exception) -> None:
        """As if the worker had died: what fell in a batch is tried alone, then counted."""
        with self._catalog.write() as session:
            for job in held(session, token_of(jobs[0]), jobs):
                job.claimed_together = len(jobs)
                fallen(session, job, self._max_attempts, cause=type(error).__name__)


def no_vocabulary() -> Conflict:
    return Conflict(
        "no_vocabulary",
        "The map's extractor needs a vocabulary and the map has none yet. Fit one on its photos "
        "(POST /api/v1/vocabularies) or import one (POST /api/v1/vocabularies/import).",
    )
