"""Taking the steward's own jobs: one at a time, under a lease, whatever it comes to."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass

from sqlalchemy.exc import SQLAlchemyError

from services.steward.metrics import StewardMetrics
from shared.catalog.away import Outage
from shared.catalog.session import Catalog
from shared.errors import PlacewiseError, Unavailable
from shared.jobs import Job, JobKind, claim, hold_lease
from shared.jobs.cancel_batch import cancel_items
from shared.jobs.finish import fail, release
from shared.jobs.leases import fallen, held, token_of
from shared.jobs.on_behalf import on_behalf_of
from shared.settings import Settings

log = logging.getLogger(__name__)

IDLE_SECONDS = 0.5
AWAY_SECONDS = 2.0  # pause of a job when the object store, the search tier or the catalog is away


class Stopped(Exception):
    """The job was cancelled, or its steward is to end."""


@dataclass(frozen=True, slots=True)
class Taker:
    """Takes jobs of some kinds; `do` does one, or a slice of it, and ends or releases it itself."""

    catalog: Catalog
    settings: Settings
    name: str
    kinds: tuple[JobKind, ...]
    metrics: StewardMetrics

    def run(self, stop: threading.Event, do: Callable[[Job], None]) -> None:
        """Take jobs until `stop` is set."""
        outage = Outage(f"steward's {' and '.join(self.kinds)} worker")
        while not stop.is_set():
            try:
                done = self.take_next(do)
                outage.over()
                if not done:
                    stop.wait(IDLE_SECONDS)
            except SQLAlchemyError as error:
                outage.met(error)
                stop.wait(AWAY_SECONDS)

    def take_next(self, do: Callable[[Job], None]) -> bool:
        """Do the next job; False when there is none."""
        lease_seconds = self.settings.lease_seconds
        with self.catalog.write() as session:
            jobs = claim(
                session, worker=self.name, limit=1, lease_seconds=lease_seconds, kinds=self.kinds
            )
        if not jobs:
            return False
        job = jobs[0]
        outcome = "done"
        with (
            hold_lease(self.catalog, token_of(job), lease_seconds),
            on_behalf_of(jobs, job.kind),
        ):
            try:
                do(job)
            except Stopped:
                outcome = "stopped"
                self._end(job, release)
            except (Unavailable, OSError, SQLAlchemyError) as error:
                outcome = "paused"
                log.warning("the job %s (%s) pauses: %s", job.id, job.kind, error)
                self._end(job, lambda mine: release(mine, after_seconds=AWAY_SECONDS))
            except PlacewiseError as error:
                outcome = "failed"
                self._fail(job, error)
            except Exception as error:
                outcome = "crashed"
                log.exception("the job %s (%s) crashed", job.id, job.kind)
                self._crashed(job, error)
            log.info("a step of %s: %s", job.kind, outcome, extra={"job_id": str(job.id)})
        self.metrics.job(job.kind, outcome)
        return True

    def _end(self, job: Job, how: Callable[[Job], None]) -> None:
        with self.catalog.write() as session:
            for mine in held(session, token_of(job), [job]):
                how(mine)

    def _fail(self, job: Job, error: PlacewiseError) -> None:
        with self.catalog.write() as session:
            for mine in held(session, token_of(job), [job]):
                fail(mine, error.as_problem())
                cancel_items(session, mine)

    def _crashed(self, job: Job, error: Exception) -> None:
        with self.catalog.write() as session:
            for mine in held(session, token_of(job), [job]):
                fallen(session, mine, self.settings.max_attempts, cause=type(error).__name__)
