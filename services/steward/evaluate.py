"""Evaluation jobs: measure a map's active generation, and keep what its scores mean.

They run in a thread of their own, beside the steward's duties, and take only the search tier's
time: no photo is described for them. One that was killed begins anew.
"""

from __future__ import annotations

import threading
import time
from typing import Any

from services.steward.measure import Measure
from services.steward.take import Stopped, Taker, token_of
from shared.catalog.chunks import count_searchable
from shared.catalog.evaluations import Evaluation
from shared.catalog.generations import Generation, active_generation
from shared.catalog.session import Catalog
from shared.errors import Conflict
from shared.ids import new_id
from shared.jobs import Job, JobKind
from shared.jobs.finish import succeed
from shared.jobs.leases import held
from shared.search_protocol import SearchPort
from shared.settings import Settings

REPORT_SECONDS = 0.5  # between two notes of the progress


class Evaluator:
    """Does one evaluation after the other; `run` until stopped."""

    def __init__(self, catalog: Catalog, search: SearchPort, settings: Settings, name: str) -> None:
        self._catalog = catalog
        self._search = search
        self._settings = settings
        self._taker = Taker(catalog, settings, name, JobKind.EVALUATE)

    def run(self, stop: threading.Event) -> None:
        """Take evaluation jobs until `stop` is set."""
        self._taker.run(stop, lambda job: self._evaluate(job, stop))

    def evaluate_next(self, stop: threading.Event) -> bool:
        """Do the next evaluation job; False when there is none."""
        return self._taker.take_next(lambda job: self._evaluate(job, stop))

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
            for mine in held(session, token_of(job), [job]):
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
            mine = held(session, token_of(job), [job])
            for current in mine:
                current.progress_total = max(1, total or current.progress_total)
                current.progress_done = min(asked, current.progress_total)
        if not mine:
            raise Stopped
