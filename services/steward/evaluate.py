"""Evaluation jobs: measure a map's active generation, and keep what its scores mean.

They run in a thread of their own, beside the steward's duties, and take only the search tier's
time: no photo is described for them. One that was killed begins anew.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from typing import Any
from uuid import UUID

from sqlalchemy.exc import SQLAlchemyError

from services.steward.measure import Measure
from shared.catalog.away import Outage
from shared.catalog.chunks import count_searchable
from shared.catalog.evaluations import Evaluation
from shared.catalog.generations import Generation, active_generation
from shared.catalog.session import Catalog
from shared.errors import Conflict, PlacewiseError, Unavailable
from shared.ids import new_id
from shared.jobs import Job, claim, hold_lease
from shared.jobs.finish import fail, release, succeed
from shared.jobs.leases import fallen, held
from shared.jobs.table import STEWARD_JOBS
from shared.search_protocol import SearchPort
from shared.settings import Settings

log = logging.getLogger(__name__)

IDLE_SECONDS = 0.5
AWAY_SECONDS = 2.0  # pause of a job when the search tier or the catalog is away
REPORT_SECONDS = 0.5  # between two notes of the progress


class Stopped(Exception):
    """The job was cancelled, or its steward is to end."""


class Evaluator:
    """Does one evaluation after the other; `run` until stopped."""

    def __init__(self, catalog: Catalog, search: SearchPort, settings: Settings, name: str) -> None:
        self._catalog = catalog
        self._search = search
        self._settings = settings
        self._name = name

    def run(self, stop: threading.Event) -> None:
        """Take evaluation jobs until `stop` is set."""
        outage = Outage("evaluator")
        while not stop.is_set():
            try:
                done = self.evaluate_next(stop)
                outage.over()
                if not done:
                    stop.wait(IDLE_SECONDS)
            except SQLAlchemyError as error:
                outage.met(error)
                stop.wait(AWAY_SECONDS)

    def evaluate_next(self, stop: threading.Event) -> bool:
        """Do the next evaluation job; False when there is none."""
        lease_seconds = self._settings.lease_seconds
        with self._catalog.write() as session:
            jobs = claim(
                session,
                worker=self._name,
                limit=1,
                lease_seconds=lease_seconds,
                kinds=STEWARD_JOBS,
            )
        if not jobs:
            return False
        job = jobs[0]
        with hold_lease(self._catalog, _token(job), lease_seconds):
            try:
                self._evaluate(job, stop)
            except Stopped:
                self._end(job, release)
            except (Unavailable, OSError, SQLAlchemyError) as error:
                log.warning("the evaluation %s pauses: %s", job.id, error)
                self._end(job, lambda mine: release(mine, after_seconds=AWAY_SECONDS))
            except PlacewiseError as error:
                problem = error.as_problem()
                self._end(job, lambda mine: fail(mine, problem))
            except Exception as error:
                log.exception("the evaluation %s crashed", job.id)
                self._crashed(job, error)
        return True

    def _evaluate(self, job: Job, stop: threading.Event) -> None:
        with self._catalog.read() as session:
            generation = active_generation(session, job.map_id)
            if generation is None:
                raise Conflict("nothing_to_evaluate", "The map has no described photo yet.")
            searchable = count_searchable(session, generation.id)
        asked, reported = 0, time.monotonic()

        def on_asked() -> None:
            nonlocal asked, reported
            asked += 1
            if stop.is_set():
                raise Stopped
            if time.monotonic() - reported > REPORT_SECONDS:
                reported = time.monotonic()
                self._report(job, asked)

        measure = Measure(
            self._catalog, self._search, generation, self._settings.estimate_radius_m, on_asked
        )
        sample = measure.sample(job.params["sample"], job.params["seed"])
        self._report(job, 0, len(sample) + len(measure.queries))
        measured = measure.run(sample)
        evaluation_id = new_id()
        with self._catalog.write() as session:
            for mine in held(session, _token(job), [job]):
                session.get_one(
                    Generation, generation.id
                ).calibration = measured.calibration.model_dump()
                session.add(
                    Evaluation(
                        id=evaluation_id,
                        map_id=job.map_id,
                        generation_id=generation.id,
                        automatic=job.params["automatic"],
                        searchable=searchable,
                        labelled_queries=len(measure.queries),
                        figures=measured.figures,
                    )
                )
                result: dict[str, Any] = {
                    "evaluation_id": str(evaluation_id),
                    "generation_id": str(generation.id),
                    **measured.figures,
                }
                succeed(mine, result)

    def _report(self, job: Job, asked: int, total: int | None = None) -> None:
        """Note the progress; Stopped when the job is no longer ours."""
        with self._catalog.write() as session:
            mine = held(session, _token(job), [job])
            for current in mine:
                current.progress_total = max(1, total or current.progress_total)
                current.progress_done = min(asked, current.progress_total)
        if not mine:
            raise Stopped

    def _end(self, job: Job, how: Callable[[Job], None]) -> None:
        with self._catalog.write() as session:
            for mine in held(session, _token(job), [job]):
                how(mine)

    def _crashed(self, job: Job, error: Exception) -> None:
        with self._catalog.write() as session:
            for mine in held(session, _token(job), [job]):
                fallen(session, mine, self._settings.max_attempts, cause=type(error).__name__)


def _token(job: Job) -> UUID:
    assert job.lease_token is not None, "a claimed job carries a token"
    return job.lease_token
