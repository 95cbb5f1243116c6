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
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import replace
from typing import Any

from prometheus_client import CollectorRegistry

import services.extractor.describe
import services.extractor.model_changes  # noqa: F401  (they register their handlers)
from services.extractor.added_models import AddedModelLoader
from services.extractor.decoder_pool import DecoderPool
from services.extractor.fits import ComputeFit, FitWorker, compute_in_child
from services.extractor.generation_resolver import reindex_outdated_generations
from services.extractor.handlers import HANDLERS, ExtractorContext, JobBatch
from services.extractor.metrics import ExtractorMetrics
from services.extractor.model_registry import ModelRegistry
from shared.catalog.database.session import Catalog
from shared.catalog.jobs import DRAINED_JOBS, SINGLE_CLAIM_JOBS, WaitingFor
from shared.catalog.processes import PROCESS_HEARTBEAT_SECONDS, list_processes
from shared.config.settings import Settings
from shared.errors import PlacewiseError
from shared.jobs import Job, Priority, Wakeups
from shared.jobs.claim import fair_batch_size, mark_started
from shared.jobs.queue_depth import PolledValue
from shared.jobs.runner import JobRunner, job_trace_context
from shared.jobs.transitions import make_waiting_jobs_claimable
from shared.storage import ObjectStore
from shared.telemetry.heartbeat import Heartbeat

log = logging.getLogger(__name__)

DONE = object()  # a handler that has ended
QUERY_POLL_SECONDS = 0.1  # polling interval for queries while a bulk batch is described


class ExtractorWorker:
    """Worker that describes the photos of queued jobs, one per GPU, or per process on a CPU.

    Call `run` to work until stopped, or `drain` once.
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
        decoders: DecoderPool | None = None,
        compute_fit: ComputeFit = compute_in_child,
        wakeups: Wakeups | None = None,
    ) -> None:
        """Create a worker with a name for its leases, which reports its jobs to `wakeups`.

        As the `only_worker`, so that none can be of another release, it reindexes outdated
        generations.
        """
        self._metrics = ExtractorMetrics(registry or CollectorRegistry())
        self._heartbeat = Heartbeat(settings.heartbeat_file)
        self._only_worker = only_worker
        self._stop = threading.Event()  # replaced by that of the caller, when there are jobs

        def is_stopping() -> bool:
            return self._stop.is_set()

        load_added = AddedModelLoader(catalog, store, settings, is_stopping).load
        models = ModelRegistry(store, settings, load_added, self._metrics.observe_model_load)
        self.context = ExtractorContext(
            catalog, store, settings, models, decoders or DecoderPool(settings), is_stopping
        )
        on_outcome = self._metrics.count_step_outcome
        self.fits = FitWorker(self.context, name, on_outcome, compute_fit, wakeups)
        self._runner = JobRunner(catalog, settings, name, DRAINED_JOBS, on_outcome, wakeups)
        # Two threads, so that a query's photo does not wait for the photos of the next batch.
        self._prepare_executor = ThreadPoolExecutor(max_workers=2, thread_name_prefix="prepare")
        self._query_executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="queries")
        self._publish_executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="publish")
        self._pending_publish: Future[None] | None = None
        self._extractors = PolledValue(
            (lambda: 1) if only_worker else self._count_extractors, PROCESS_HEARTBEAT_SECONDS
        )

    def state(self) -> dict[str, Any]:
        """Return the device, and the models with their errors, as the process registers them."""
        return self.context.models.state

    def warm_up(self, stop: threading.Event) -> None:
        """Load the extractor of new maps, so that the first photo does not wait for it.

        Photos that wait for a vocabulary since POOL_WITHOUT_VOCABULARY was off wait no longer.
        """
        self._stop = stop
        settings = self.context.settings
        if settings.pool_without_vocabulary:
            with self.context.catalog.write() as session:
                make_waiting_jobs_claimable(session, Job.waiting_for == WaitingFor.VOCABULARY)
        try:
            self.context.models.extractor(settings.new_map_extractor)
        except PlacewiseError as error:
            # Not fatal: maps may use another extractor, and jobs that need this one report it.
            log.error("the extractor of new maps can't be loaded: %s: %s", error.code, error.detail)
        if self._only_worker:
            reindex_outdated_generations(self.context.catalog, self.context.models)

    def run(self, stop: threading.Event, wait: Callable[[float], object]) -> None:
        """Drain whenever there is work, until `stop` is set; `wait` waits for a wakeup.

        Fits run in a thread of their own (`fits`).
        """
        self._runner.run(lambda: self.drain(stop), stop, wait)

    def close(self) -> None:
        """Stop the threads and decoders; claimed jobs are requeued when their lease expires."""
        self._query_executor.shutdown(wait=True)
        self._publish_executor.shutdown(wait=True)
        self._prepare_executor.shutdown(wait=True, cancel_futures=True)
        self.context.decoders.close()

    def drain(self, stop: threading.Event) -> bool:
        """Process jobs until none is claimable, or `stop` is set; return whether there was one."""
        self._stop = stop
        current, upcoming = None, self._claim()
        if upcoming is None:
            return False
        with self._metrics.measure_drain():
            try:
                while upcoming is not None:
                    if stop.is_set():
                        with upcoming.lease:
                            self._runner.requeue(upcoming)
                        break
                    current = upcoming
                    # Claimed before the forward pass, so that its photos are decoded meanwhile.
                    upcoming = self._claim()
                    if not _is_query(current):
                        # Otherwise the query would wait for this batch and the one being published.
                        while upcoming is not None and _is_query(upcoming) and not stop.is_set():
                            self._process(upcoming, stop)
                            upcoming = self._claim()
                    self._process(current, stop)
                    if upcoming is None:
                        self._wait_for_publish()  # which may requeue jobs
                        upcoming = self._claim()
            finally:
                # Without the catalog, claimed jobs are requeued when their lease expires.
                for unfinished in (current, upcoming):
                    if unfinished is not None:
                        unfinished.lease.close()
                self._wait_for_publish()
        return True

    def _claim(self, min_priority: int | None = None, *, alone: bool = True) -> JobBatch | None:
        """Claim the next batch and begin to prepare it."""
        self._heartbeat.beat()  # for each batch: a drain may last for several
        claimed = self._runner.claim(
            self._fair_batch_size(), min_priority, alone=alone, started=False
        )
        if claimed is None:
            return None
        self._metrics.observe_claim(claimed.kind, len(claimed.jobs))
        batch = JobBatch(claimed.jobs, claimed.lease)
        batch.stages = HANDLERS[batch.kind](self.context, batch)
        batch.prepared = self._prepare_executor.submit(self._prepare, batch)
        return batch

    def _fair_batch_size(self) -> int:
        limit, workers = self.context.settings.batch_photos, self._extractors.get()
        waiting = self._runner.count_waiting(2 * workers * limit) if workers > 1 else 0
        return fair_batch_size(waiting, workers, limit)

    def _count_extractors(self) -> int:
        with self.context.catalog.read() as session:
            found = list_processes(session)
        return sum(process.role == "extractor" and process.is_live for process in found)

    def _prepare(self, batch: JobBatch) -> bool:
        with job_trace_context(batch.jobs, "prepare"):
            return next(batch.stages, DONE) is not DONE

    def _process(self, batch: JobBatch, stop: threading.Event) -> None:
        """Describe and publish a batch, beside as little else as it allows."""
        if _runs_exclusively(batch):
            self._wait_for_publish()
            self._run(batch)
        elif _is_query(batch):
            self._run(batch, 0 if self._pending_publish is None else 1)
        else:
            with self._answering_queries(stop):
                self._run(batch, 1, publish_later=True)

    def _run(
        self,
        batch: JobBatch,
        concurrent_jobs: int = 0,
        *,
        publish_later: bool = False,
    ) -> None:
        """Describe and publish a batch.

        `concurrent_jobs` other jobs are in progress at the same time, any of which may be the cause
        of a crash. With `publish_later`, the batch is published while the model runs the next one.
        """
        with batch.lease:
            if not self._describe(batch, concurrent_jobs):
                return
            if not publish_later:
                self._publish(batch)
                return
            self._wait_for_publish()
            described = replace(batch, lease=batch.lease.pop_all())
            self._pending_publish = self._publish_executor.submit(self._publish, described)

    def _describe(self, batch: JobBatch, concurrent_jobs: int) -> bool:
        """Run the stage of the batch that needs the model; return whether one follows."""
        with self._runner.step(batch, "describe"):
            if batch.prepared.result():
                # From here on a crash may be caused by a photo: decoding ran in other processes.
                with self.context.catalog.write() as session:
                    mark_started(session, batch.token, len(batch.jobs) + concurrent_jobs)
                self._runner.report_started(batch)
                if next(batch.stages, DONE) is not DONE:
                    return True
        self._record(batch)
        return False

    def _publish(self, batch: JobBatch) -> None:
        with batch.lease, self._runner.step(batch, "publish"):
            next(batch.stages, DONE)
        self._record(batch)

    def _record(self, batch: JobBatch) -> None:
        self._metrics.observe_batch(batch)
        self._runner.report_ended(batch)

    @contextlib.contextmanager
    def _answering_queries(self, stop: threading.Event) -> Iterator[None]:
        """Describe queries in another thread while the block describes a bulk batch."""
        done = threading.Event()
        queries = self._query_executor.submit(self._poll_queries, done, stop)
        try:
            yield
        finally:
            done.set()
            wait([queries])
        queries.result()

    def _poll_queries(self, done: threading.Event, stop: threading.Event) -> None:
        while not (done.is_set() or stop.is_set()):
            query = None
            if self._runner.has_jobs(Priority.QUERY, alone=False):
                query = self._claim(Priority.QUERY, alone=False)
            if query is None:
                done.wait(QUERY_POLL_SECONDS)
            else:
                self._run(query, 1)

    def _wait_for_publish(self) -> None:
        pending, self._pending_publish = self._pending_publish, None
        if pending is not None:
            pending.result()


def _is_query(batch: JobBatch) -> bool:
    return batch.jobs[0].priority >= Priority.QUERY


def _runs_exclusively(batch: JobBatch) -> bool:
    """Whether nothing may run concurrently, so that a crash can be attributed to the job."""
    return batch.jobs[0].alone or batch.kind in SINGLE_CLAIM_JOBS
