"""Worker for evaluation jobs, which search a live map with its own photos.

An evaluation measures the active generation and stores the model of its estimates. The jobs run
in a thread of their own, parallel to the periodic tasks, and load the search tier only: they
describe no photos. A job whose steward died starts from the beginning.
"""

from __future__ import annotations

import threading
from uuid import UUID

from prometheus_client import CollectorRegistry

from services.steward.map_evaluation import MapEvaluation
from services.steward.metrics import StewardMetrics
from shared.catalog.chunks import count_searchable
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Evaluation, Generation, active_generation
from shared.catalog.maps import Map, decide_label_paths
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


class EvaluationWorker:
    """Runs evaluation jobs one after the other."""

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
        metrics = metrics or StewardMetrics(CollectorRegistry())
        self._runner = JobRunner(catalog, settings, name, (JobKind.EVALUATE,), metrics.count_jobs)

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
            labels_are_paths = decide_label_paths(session, map_)
        evaluation = MapEvaluation(
            self._catalog,
            self._store,
            self._search,
            generation,
            self._settings.estimate_radius_m,
            LevelScheme(labels_are_paths=labels_are_paths, radii_m=self._settings.level_radii_m),
            map_.matching,
            progress.advance,
        )
        self._evaluate(job, generation, searchable, evaluation, progress)

    def _evaluate(
        self,
        job: Job,
        generation: Generation,
        searchable: int,
        evaluation: MapEvaluation,
        progress: JobProgress,
    ) -> None:
        sample = evaluation.draw_sample(job.params["sample"], job.params["seed"])
        queries = [*sample, *evaluation.queries, *evaluation.denied]
        searched = len(queries) + evaluation.matched_photos(sample)
        progress.total = searched
        evaluated = evaluation.evaluate(sample)
        result = {"evaluation_id": str(new_id()), "generation_id": str(generation.id)}
        result |= evaluated.figures
        with self._catalog.write() as session:
            # Before the job, in the order in which a deletion of the map locks them.
            map_ = session.get(Map, job.map_id, with_for_update=True)
            leased = lock_leased_job(session, job)
            if map_ is None or leased is None:
                return
            if map_.place_labels_are_automatic:
                map_.place_labels_are_paths = evaluation.scheme.labels_are_paths
            current = session.get_one(Generation, generation.id)
            current.calibration = evaluated.model.model_dump(mode="json")
            current.uses_matches = evaluated.uses_matches
            session.add(
                Evaluation(
                    id=UUID(result["evaluation_id"]),
                    map_id=job.map_id,
                    generation_id=generation.id,
                    automatic=job.params["automatic"],
                    searchable=searchable,
                    labelled_queries=len(evaluation.queries),
                    figures=evaluated.figures,
                )
            )
            succeed_job(leased, result)
