"""Evaluation jobs: measure a map's active generation, and keep what its scores mean.

Word weights are learnt here, too: both ask a live map with its own photos. They run in a thread of
their own, beside the steward's duties, and take only the search tier's time: no photo is described
for them. One that was killed begins anew.
"""

from __future__ import annotations

import threading
from typing import Any
from uuid import UUID

from prometheus_client import CollectorRegistry
from sqlalchemy.orm import Session

from services.steward.asked import Asked
from services.steward.measure import Measure
from services.steward.metrics import StewardMetrics
from services.steward.take import Taker
from services.steward.word_weights import LearnWords
from shared.catalog.chunks import count_searchable
from shared.catalog.evaluations import Evaluation
from shared.catalog.generations import Generation, active_generation
from shared.catalog.session import Catalog
from shared.catalog.vocabularies import Vocabulary, why_no_word_weights
from shared.errors import Conflict
from shared.estimate.calibration import Calibration
from shared.ids import new_id
from shared.jobs import Job, JobKind
from shared.jobs.finish import succeed
from shared.jobs.leases import held, token_of
from shared.objects import ObjectStore
from shared.search_protocol import SearchPort
from shared.settings import Settings
from shared.word_weights.record import stored_word_weights


class Evaluator:
    """Does one evaluation, or learning of weights, after the other; `run` until stopped."""

    def __init__(
        self,
        catalog: Catalog,
        store: ObjectStore,
        search: SearchPort,
        settings: Settings,
        name: str,
        metrics: StewardMetrics | None = None,
    ) -> None:
        self._catalog = catalog
        self._store = store
        self._search = search
        self._settings = settings
        kinds = (JobKind.EVALUATE, JobKind.WORD_WEIGHTS)
        counted = metrics or StewardMetrics(CollectorRegistry())
        self._taker = Taker(catalog, settings, name, kinds, counted)

    def run(self, stop: threading.Event) -> None:
        """Take jobs until `stop` is set."""
        self._taker.run(stop, lambda job: self._do(job, stop))

    def evaluate_next(self, stop: threading.Event) -> bool:
        """Do the next job; False when there is none."""
        return self._taker.take_next(lambda job: self._do(job, stop))

    def _do(self, job: Job, stop: threading.Event) -> None:
        asked = Asked(self._catalog, job, stop)
        with self._catalog.read() as session:
            generation = active_generation(session, job.map_id)
            if generation is None:
                raise Conflict("nothing_to_evaluate", "The map has no described photo yet.")
            searchable = count_searchable(session, generation.id)
            words = _words(session, generation) if job.kind == JobKind.WORD_WEIGHTS else 0
        measure = Measure(
            self._catalog, self._search, generation, self._settings.estimate_radius_m, asked.one
        )
        if job.kind == JobKind.WORD_WEIGHTS:
            self._weigh(job, generation, words, searchable, measure, asked)
        else:
            self._evaluate(job, generation, searchable, measure, asked)

    def _evaluate(
        self, job: Job, generation: Generation, searchable: int, measure: Measure, asked: Asked
    ) -> None:
        record = stored_word_weights(generation.word_weights)
        weights = record.applied if record else ()
        sample = measure.sample(job.params["sample"], job.params["seed"])
        asked.begin((len(sample) + len(measure.queries)) * (2 if weights else 1))
        measured = measure.run(sample)
        weighted = measure.run(sample, weights) if weights else None
        figures = {
            **measured.figures,
            "with_word_weights": weighted.figures if weighted else None,
        }
        evaluation_id = new_id()
        with self._catalog.write() as session:
            for mine in held(session, token_of(job), [job]):
                session.get_one(
                    Generation, generation.id
                ).calibration = measured.calibration.model_dump()
                if weighted:
                    _keep_weighted(session, generation.id, weights, weighted.calibration)
                session.add(
                    Evaluation(
                        id=evaluation_id,
                        map_id=job.map_id,
                        generation_id=generation.id,
                        automatic=job.params["automatic"],
                        searchable=searchable,
                        labelled_queries=len(measure.queries),
                        figures=figures,
                    )
                )
                result: dict[str, Any] = {
                    "evaluation_id": str(evaluation_id),
                    "generation_id": str(generation.id),
                    **figures,
                }
                succeed(mine, result)

    def _weigh(
        self,
        job: Job,
        generation: Generation,
        words: int,
        searchable: int,
        measure: Measure,
        asked: Asked,
    ) -> None:
        if job.params["generation_id"] != str(generation.id):
            raise Conflict(
                "generation_not_active",
                f"Another generation answers by now ({generation.id}). Learn its weights.",
                generation_id=str(generation.id),
            )
        sample = measure.sample(job.params["sample"], job.params["seed"])
        asked.begin(2 * len(sample) + len(measure.queries))
        learn = LearnWords(self._catalog, self._store, generation, words, measure)
        record = learn.run(sample, job.params["seed"], searchable)
        with self._catalog.write() as session:
            for mine in held(session, token_of(job), [job]):
                session.get_one(Generation, generation.id).word_weights = record.model_dump(
                    mode="json"
                )
                result: dict[str, Any] = {
                    "generation_id": str(generation.id),
                    **record.model_dump(mode="json", exclude={"weights", "calibration"}),
                }
                succeed(mine, result)


def _words(session: Session, generation: Generation) -> int:
    """How many words the generation's vocabulary has; Conflict (`no_word_weights`)."""
    if reason := why_no_word_weights(session, generation):
        raise Conflict("no_word_weights", f"This generation gets no word weights: {reason}.")
    return session.get_one(Vocabulary, generation.vocabulary_id).clusters


def _keep_weighted(
    session: Session, generation_id: UUID, weights: tuple[float, ...], calibration: Calibration
) -> None:
    """What scores with these weights mean, unless others have been learnt meanwhile."""
    generation = session.get_one(Generation, generation_id)
    record = stored_word_weights(generation.word_weights)
    if record and record.applied == weights:
        generation.word_weights = record.model_copy(update={"calibration": calibration}).model_dump(
            mode="json"
        )
