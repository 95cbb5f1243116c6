"""Worker for evaluation and word-weight jobs, which search a live map with its own photos.

An evaluation measures the active generation and stores the model of its estimates. The jobs run
in a thread of their own, parallel to the periodic tasks, and load the search tier only: they
describe no photos. A job whose steward died starts from the beginning.
"""

from __future__ import annotations

import threading
from uuid import UUID

from prometheus_client import CollectorRegistry
from sqlalchemy.orm import Session

from services.steward.map_evaluation import MapEvaluation
from services.steward.metrics import StewardMetrics
from services.steward.word_weights import WordWeightsFit
from shared.catalog.chunks import count_searchable
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Evaluation, Generation, active_generation
from shared.catalog.maps import Map, Matching, decide_label_paths
from shared.catalog.vocabularies import Vocabulary, word_weights_unavailable_reason
from shared.config.settings import Settings
from shared.errors import Conflict
from shared.evaluation.places.levels import LevelScheme
from shared.ids import new_id
from shared.jobs import Job, JobKind
from shared.jobs.leases import lock_leased_job
from shared.jobs.progress import JobProgress
from shared.jobs.runner import JobRunner
from shared.jobs.transitions import succeed_job
from shared.search_api.protocol import SearchBackend
from shared.storage import ObjectStore
from shared.word_weights.record import parse_word_weights


class EvaluationWorker:
    """Runs evaluation and word-weight jobs one after the other."""

    def __init__(
        self,
        catalog: Catalog,
        store: ObjectStore,
        search: SearchBackend,
        settings: Settings,
        name: str,
        metrics: StewardMetrics | None = None,
    ) -> None:
        self._catalog = catalog
        self._store = store
        self._search = search
        self._settings = settings
        kinds = (JobKind.EVALUATE, JobKind.WORD_WEIGHTS)
        metrics = metrics or StewardMetrics(CollectorRegistry())
        self._runner = JobRunner(catalog, settings, name, kinds, metrics.count_jobs)

    def run(self, stop: threading.Event) -> None:
        """Run jobs until `stop` is set."""
        self._runner.run_jobs(lambda job: self._run_job(job, stop), stop)

    def run_next(self, stop: threading.Event) -> bool:
        """Run the next job; False when there is none."""
        return self._runner.run_next(lambda job: self._run_job(job, stop))

    def _run_job(self, job: Job, stop: threading.Event) -> None:
        progress = JobProgress(self._catalog, job, stop)
        with self._catalog.read() as session:
            generation = active_generation(session, job.map_id)
            if generation is None:
                raise Conflict("nothing_to_evaluate", "The map has no described photo yet.")
            searchable = count_searchable(session, generation.id)
            map_ = session.get_one(Map, job.map_id)
            words, labels_are_paths = 0, map_.place_labels_are_paths
            if job.kind == JobKind.WORD_WEIGHTS:
                words = _count_words(session, generation)
            else:
                labels_are_paths = decide_label_paths(session, map_)
        radius_m = self._settings.estimate_radius_m
        evaluation = MapEvaluation(
            self._catalog,
            self._search,
            generation,
            radius_m,
            LevelScheme(labels_are_paths=labels_are_paths, radii_m=self._settings.level_radii_m),
            map_.matching if job.kind == JobKind.EVALUATE else Matching.OFF,
            progress.advance,
        )
        if job.kind == JobKind.WORD_WEIGHTS:
            self._fit_word_weights(job, generation, words, searchable, evaluation, progress)
        else:
            self._evaluate(job, generation, searchable, evaluation, progress)

    def _evaluate(
        self,
        job: Job,
        generation: Generation,
        searchable: int,
        evaluation: MapEvaluation,
        progress: JobProgress,
    ) -> None:
        record = parse_word_weights(generation.word_weights)
        weights = record.applied if record else ()
        sample = evaluation.draw_sample(job.params["sample"], job.params["seed"])
        searched = len(sample) + len(evaluation.queries) + evaluation.matched_photos(sample)
        progress.total = searched * (2 if weights else 1)
        unweighted = evaluation.evaluate(sample)
        weighted = evaluation.evaluate(sample, weights) if weights else None
        figures = {
            **unweighted.figures,
            "with_word_weights": weighted.figures if weighted else None,
        }
        result = {"evaluation_id": str(new_id()), "generation_id": str(generation.id), **figures}
        with self._catalog.write() as session:
            # Before the job, in the order in which a deletion of the map locks them.
            map_ = session.get(Map, job.map_id, with_for_update=True)
            leased = lock_leased_job(session, job)
            if map_ is None or leased is None:
                return
            if map_.place_labels_are_automatic:
                map_.place_labels_are_paths = evaluation.scheme.labels_are_paths
            current = session.get_one(Generation, generation.id)
            current.calibration = unweighted.model.model_dump(mode="json")
            current.uses_matches = (weighted or unweighted).uses_matches
            # Unless the weights changed meanwhile.
            record = parse_word_weights(current.word_weights)
            if weighted and record and record.applied == weights:
                record = record.model_copy(update={"calibration": weighted.model})
                current.word_weights = record.model_dump(mode="json")
            session.add(
                Evaluation(
                    id=UUID(result["evaluation_id"]),
                    map_id=job.map_id,
                    generation_id=generation.id,
                    automatic=job.params["automatic"],
                    searchable=searchable,
                    labelled_queries=len(evaluation.queries),
                    figures=figures,
                )
            )
            succeed_job(leased, result)

    def _fit_word_weights(
        self,
        job: Job,
        generation: Generation,
        words: int,
        searchable: int,
        evaluation: MapEvaluation,
        progress: JobProgress,
    ) -> None:
        if job.params["generation_id"] != str(generation.id):
            raise Conflict(
                "generation_not_active",
                f"Another generation is active now ({generation.id}). Fit its weights instead.",
                generation_id=str(generation.id),
            )
        sample = evaluation.draw_sample(job.params["sample"], job.params["seed"])
        progress.total = 2 * len(sample) + len(evaluation.queries)
        weights_fit = WordWeightsFit(self._catalog, self._store, generation, words, evaluation)
        record = weights_fit.fit(sample, job.params["seed"], searchable)
        summary = record.model_dump(mode="json", exclude={"weights", "calibration"})
        with self._catalog.write() as session:
            if leased := lock_leased_job(session, job):
                current = session.get_one(Generation, generation.id)
                current.word_weights = record.model_dump(mode="json")
                succeed_job(leased, {"generation_id": str(generation.id), **summary})


def _count_words(session: Session, generation: Generation) -> int:
    """Return the number of words in the generation's vocabulary; Conflict (`no_word_weights`)."""
    if reason := word_weights_unavailable_reason(session, generation):
        raise Conflict(
            "no_word_weights", f"This generation does not support word weights: {reason}."
        )
    return session.get_one(Vocabulary, generation.vocabulary_id).clusters
