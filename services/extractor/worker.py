"""Extractor worker: drains the job table in pipelined batches, queries first.

    claim ──> read, decode ──> forward pass, aggregate ──> chunk, transaction
              batch n + 1      batch n                      batch n - 1

Bulk batches are pipelined: while one runs on the model, the next one is read and decoded and the
previous one is published. Each stage holds one batch: a described batch waits until the previous
one is published. Its lease is renewed through all stages, up to the transaction.

A query that arrives while a bulk batch is described is described concurrently with it; where that
is not possible, it goes before the next bulk batch, so that it waits for one batch at most. Its row
is published at once, by the thread that described it.

Jobs that are retried alone, to isolate the job that crashed the worker, and model changes run
exclusively: whatever was described before is published first. Fits run beside (`fits`).
"""

from __future__ import annotations

import contextlib
import logging
import math
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from typing import Any

from prometheus_client import CollectorRegistry

from services.extractor.added_models import AddedModelLoader
from services.extractor.comparison import ComparisonRunner, PreparedComparison
from services.extractor.decoder_pool import DecoderPool
from services.extractor.fits import ComputeFit, FitWorker, compute_in_child
from services.extractor.generation_resolver import (
    defer_until_vocabulary,
    reindex_outdated_generations,
    resolve_generation,
)
from services.extractor.metrics import DrainStats, ExtractorMetrics
from services.extractor.model_changes import ModelChangeRunner
from services.extractor.model_registry import ModelRegistry
from services.extractor.prepare import DescribeBatch, describe_batch, prepare_batch
from services.extractor.publish import PublishResult, publish
from shared.catalog.database.session import Catalog
from shared.catalog.jobs import EXTRACTOR_JOBS, FIT_JOBS, MODEL_CHANGE_JOBS, JobKind, WaitingFor
from shared.config.settings import Settings
from shared.errors import PlacewiseError
from shared.jobs import InProcessWakeups, Job, Priority, mark_started
from shared.jobs.runner import ClaimedJobs, JobRunner, job_trace_context
from shared.jobs.transitions import make_waiting_jobs_claimable
from shared.storage import ObjectStore
from shared.storage.chunks import Rows
from shared.telemetry.heartbeat import Heartbeat

log = logging.getLogger(__name__)

QUERY_POLL_SECONDS = 0.1  # polling interval for queries while a bulk batch is described


@dataclass(slots=True)
class _ExtractorBatch(ClaimedJobs):
    """Claimed jobs, and the pending decoding of their photos."""

    preparation: Future[DescribeBatch | PreparedComparison | None] | None = None
    """A result of None means that the map has no vocabulary yet. The future itself is None for a
    model change and for the import of a checkpoint."""


class ExtractorWorker:
    """Worker that describes the photos of queued jobs, one per GPU, or per process on a CPU.

    Call `run` to work until stopped, or `drain` once for each wakeup.
    """

    def __init__(
        self,
        catalog: Catalog,
        store: ObjectStore,
        settings: Settings,
        name: str,
        *,
        only_worker: bool = False,
        registry: CollectorRegistry | None = None,
        compute_fit: ComputeFit = compute_in_child,
    ) -> None:
        """Create a worker with a name for its leases.

        As the `only_worker`, so that none can be of another release, it reindexes outdated
        generations.
        """
        self._metrics = ExtractorMetrics(registry or CollectorRegistry())
        self._catalog = catalog
        self._store = store
        self._settings = settings
        self._heartbeat = Heartbeat(settings.heartbeat_file)
        self._only_worker = only_worker
        added = AddedModelLoader(catalog, store, settings)
        self._models = ModelRegistry(store, settings, added.load, self._metrics.observe_model_load)
        self._decoders = DecoderPool(settings)
        self._model_changes = ModelChangeRunner(catalog, store, self._models, settings)
        self._comparisons = ComparisonRunner(catalog, store, self._models, self._decoders, settings)
        self.fits = FitWorker(
            catalog,
            store,
            self._models,
            settings,
            name,
            self._metrics.count_step_outcome,
            compute_fit,
        )
        drained = [kind for kind in EXTRACTOR_JOBS if kind not in FIT_JOBS]
        self._runner = JobRunner(catalog, settings, name, drained, self._metrics.count_step_outcome)
        # Two threads, so that a query's photo does not wait for the photos of the next batch.
        self._prepare_executor = ThreadPoolExecutor(max_workers=2, thread_name_prefix="prepare")
        self._query_executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="queries")
        self._publish_executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="publish")
        self._pending_publish: Future[DrainStats] | None = None

    def state(self) -> dict[str, Any]:
        """Return the device, and the models with their errors, as the process registers them."""
        return self._models.state

    def warm_up(self) -> None:
        """Load the extractor of new maps, so that the first photo does not wait for it.

        Photos that wait for a vocabulary since POOL_WITHOUT_VOCABULARY was off are released.
        """
        if self._settings.pool_without_vocabulary:
            with self._catalog.write() as session:
                make_waiting_jobs_claimable(session, Job.waiting_for == WaitingFor.VOCABULARY)
        try:
            self._models.extractor(self._settings.new_map_extractor)
        except PlacewiseError as error:
            # Not fatal: maps may use another extractor, and jobs that need this one report it.
            log.error("the extractor of new maps can't be loaded: %s", error.detail)
        if self._only_worker:
            reindex_outdated_generations(self._catalog, self._models)

    def run(self, stop: threading.Event, wakeups: InProcessWakeups) -> None:
        """Drain whenever there is work, until `stop` is set; used by the embedded worker.

        Fits run in a thread of their own (`fits`).
        """
        self.warm_up()

        def drain() -> bool:
            result = self.drain(stop)
            if result.claimed:
                log.info("drained: %s", result.as_dict())
            return result.claimed > 0

        self._runner.run(drain, stop, wakeups.wait)

    def drain_once(self, stop: threading.Event, seconds: float) -> DrainStats | None:
        """Drain as `drain` does; pause and return None if the catalog was unavailable."""
        return self._runner.run_once(lambda: self.drain(stop, seconds), stop)

    def close(self) -> None:
        """Stop the threads and decoders; claimed jobs are requeued when their lease expires."""
        self._query_executor.shutdown(wait=True)
        self._publish_executor.shutdown(wait=True)
        self._prepare_executor.shutdown(wait=True, cancel_futures=True)
        self._decoders.close()

    def drain(self, stop: threading.Event, seconds: float = math.inf) -> DrainStats:
        """Process jobs until none is claimable, `stop` is set, or `seconds` have passed."""
        result = DrainStats()
        first = self._claim_next(result)
        if first is not None:
            with self._metrics.measure_drain():
                self._drain(first, stop, time.monotonic() + seconds, result)
        return result

    def _drain(
        self, first: _ExtractorBatch, stop: threading.Event, until: float, result: DrainStats
    ) -> None:
        current: _ExtractorBatch | None = None
        upcoming: _ExtractorBatch | None = first

        def out_of_time() -> bool:
            return stop.is_set() or time.monotonic() > until

        try:
            while upcoming is not None:
                if out_of_time():
                    with upcoming.lease:
                        self._runner.requeue(upcoming)
                    result.interrupted = True
                    break
                current = upcoming
                # Claimed before the forward pass, so that its photos are decoded meanwhile.
                upcoming = self._claim_next(result)
                if not _is_query(current):
                    # Otherwise the query would wait for this batch and the one being published.
                    while upcoming is not None and _is_query(upcoming) and not out_of_time():
                        self._process_in_order(upcoming, result, stop)
                        upcoming = self._claim_next(result)
                self._process_in_order(current, result, stop)
                if upcoming is None:
                    self._wait_for_publish(result)  # which may requeue jobs
                    upcoming = self._claim_next(result)
        finally:
            # Without the catalog, claimed jobs are requeued when their lease expires.
            for unfinished in (current, upcoming):
                if unfinished is not None:
                    unfinished.lease.close()
            self._wait_for_publish(result)

    def _process_in_order(
        self, work: _ExtractorBatch, result: DrainStats, stop: threading.Event
    ) -> None:
        if _runs_exclusively(work):
            self._wait_for_publish(result)
            self._process(work, result)
        elif _is_query(work):
            self._process(work, result, concurrent_jobs=0 if self._pending_publish is None else 1)
        else:
            with self._answering_queries(result, stop):
                self._process(work, result, concurrent_jobs=1, publish_async=True)

    @contextlib.contextmanager
    def _answering_queries(self, result: DrainStats, stop: threading.Event) -> Iterator[None]:
        """Describe queries in another thread while the block describes a bulk batch."""
        done, query_stats = threading.Event(), DrainStats()
        queries = self._query_executor.submit(self._poll_queries, done, stop, query_stats)
        try:
            yield
        finally:
            done.set()
            wait([queries])
            result.merge(query_stats)
        queries.result()

    def _poll_queries(
        self, done: threading.Event, stop: threading.Event, result: DrainStats
    ) -> None:
        while not (done.is_set() or stop.is_set()):
            query = (
                self._claim_next(result, min_priority=Priority.QUERY, alone=False)
                if self._runner.has_jobs(Priority.QUERY, alone=False)
                else None
            )
            if query is None:
                done.wait(QUERY_POLL_SECONDS)
            else:
                self._process(query, result, concurrent_jobs=1)

    def _claim_next(
        self, result: DrainStats, min_priority: int | None = None, *, alone: bool = True
    ) -> _ExtractorBatch | None:
        self._heartbeat.beat()  # for each batch: a drain may last for several
        claimed = self._runner.claim(
            self._settings.batch_photos, min_priority, alone=alone, started=False
        )
        if claimed is None:
            return None
        jobs = claimed.jobs
        self._metrics.observe_claim(claimed.kind, len(jobs))
        result.claimed += len(jobs)
        result.maps.add(str(jobs[0].map_id))
        work = _ExtractorBatch(jobs, claimed.lease)
        if claimed.kind == JobKind.COMPARE:
            work.preparation = self._prepare_executor.submit(self._comparisons.prepare, jobs[0])
        elif claimed.kind not in (JobKind.ADD_MODEL, *MODEL_CHANGE_JOBS):
            work.preparation = self._prepare_executor.submit(self._prepare, jobs)
        return work

    def _prepare(self, jobs: list[Job]) -> DescribeBatch | None:
        with job_trace_context(jobs, "prepare"):
            target = resolve_generation(self._catalog, self._store, self._models, jobs[0])
            if target is None:
                return None
            return prepare_batch(self._catalog, self._store, self._decoders, jobs, target)

    def _process(
        self,
        work: _ExtractorBatch,
        result: DrainStats,
        concurrent_jobs: int = 0,
        *,
        publish_async: bool = False,
    ) -> None:
        """Describe and publish a batch, and update the statistics of `result`.

        `concurrent_jobs` other jobs are in progress at the same time, any of which may be the cause
        of a crash. With `publish_async`, the batch is published while the model runs the next one.
        """
        with work.lease:
            rows = self._describe_claimed(work, result, concurrent_jobs)
            if rows is None:
                return
            if not publish_async:
                self._publish(work, rows, result)
                return
            self._wait_for_publish(result)
            moved = replace(work, lease=work.lease.pop_all())
            self._pending_publish = self._publish_executor.submit(
                self._publish_in_background, moved, rows
            )

    def _describe_claimed(
        self, work: _ExtractorBatch, result: DrainStats, concurrent_jobs: int
    ) -> Rows | None:
        """Return a row for each job of the batch's `ready`; None if there is nothing to publish."""
        with self._step(work, "describe", result):
            if work.preparation is None:
                started = time.perf_counter()
                self._mark_begun(work)
                self._model_changes.run(work.jobs[0])
                took = time.perf_counter() - started
                result.seconds["model change"] += took
                self._metrics.observe_stage("model change", took)
                return None
            batch = work.preparation.result()
            if batch is None:
                defer_until_vocabulary(self._catalog, work.jobs)
                self._metrics.count_outcome(work.kind, "waiting", len(work.jobs))
                return None
            self._mark_begun(work, concurrent_jobs)
            if isinstance(batch, PreparedComparison):
                self._record_outcome(work, result, self._comparisons.run(batch), batch.seconds)
                return None
            return describe_batch(batch)
        return None  # the failure has been handled

    @contextlib.contextmanager
    def _step(self, work: _ExtractorBatch, name: str, result: DrainStats) -> Iterator[None]:
        with self._runner.step(work, name):
            yield
        result.failed += work.failed

    def _publish(self, work: _ExtractorBatch, rows: Rows, result: DrainStats) -> None:
        with self._step(work, "publish", result):
            batch = work.preparation.result() if work.preparation else None
            assert isinstance(batch, DescribeBatch), "only described batches are published"
            outcome = publish(self._catalog, self._store, batch, rows, self._settings.slot_rows)
            self._record_outcome(work, result, outcome, batch.seconds)

    def _record_outcome(
        self,
        work: _ExtractorBatch,
        result: DrainStats,
        outcome: PublishResult,
        seconds: dict[str, float],
    ) -> None:
        result.add_batch(outcome, seconds)
        self._metrics.observe_batch(work.kind, outcome, seconds)

    def _publish_in_background(self, work: _ExtractorBatch, rows: Rows) -> DrainStats:
        result = DrainStats()
        with work.lease:
            self._publish(work, rows, result)
        return result

    def _wait_for_publish(self, result: DrainStats) -> None:
        """Wait for the pending background publication and add its statistics."""
        pending, self._pending_publish = self._pending_publish, None
        if pending is not None:
            result.merge(pending.result())

    def _mark_begun(self, work: _ExtractorBatch, concurrent_jobs: int = 0) -> None:
        """Record that jobs have started: from here on a crash may be caused by a photo.

        Decoding runs in other processes and is finished.
        """
        with self._catalog.write() as session:
            mark_started(session, work.token, len(work.jobs) + concurrent_jobs)


def _is_query(work: _ExtractorBatch) -> bool:
    return work.jobs[0].priority >= Priority.QUERY


def _runs_exclusively(work: _ExtractorBatch) -> bool:
    """Whether nothing may run concurrently, so that a crash can be attributed to the job.

    Steps of model changes come as a batch of one job and run exclusively, too.
    """
    return work.preparation is None or work.jobs[0].alone
