"""Extractor worker: drains the job table in three stages, queries first.

    claim, read, decode ──> forward pass, aggregate ──> chunk, transaction
    `drain`: batch n + 1    "describe": batch n         "publish": batch n - 1

Each stage is a thread that holds one batch: a batch waits in its stage until the next one is free.
Its lease is renewed through all stages, up to the transaction. An exception of a stage that is not
a job's ends `drain`.

A query that arrives meanwhile runs through all stages in a thread of its own, "queries", or in
that of `drain`, so that it waits for no batch.

Jobs that are retried alone, to isolate the job that crashed the worker, and model changes run
exclusively: whatever was claimed before is published first. Fits run beside (`fits`).
"""

from __future__ import annotations

import contextlib
import logging
import os
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
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
from shared.catalog.jobs import DRAINED_JOBS, SINGLE_CLAIM_JOBS
from shared.catalog.processes import PROCESS_HEARTBEAT_SECONDS, list_processes
from shared.config.settings import Settings
from shared.descriptors.extractor import choose_device
from shared.errors import PlacewiseError
from shared.jobs import Priority, Wakeups
from shared.jobs.claim import fair_batch_size, mark_started
from shared.jobs.queue_depth import PolledValue
from shared.jobs.runner import IDLE_POLL_SECONDS, JobRunner
from shared.storage import ObjectStore
from shared.telemetry.heartbeat import Heartbeat

log = logging.getLogger(__name__)

DONE = object()  # a handler that has ended
QUERY_PAUSE_SECONDS = 0.02  # after a look, where commits are announced
BATCH_NICENESS = 5  # of the threads that describe a batch: a query gets three times their share


class Stage:
    """A thread that works on one batch at a time."""

    def __init__(self, name: str, niceness: int = 0) -> None:
        # On Linux the niceness is that of a thread; elsewhere it would be that of the process.
        self.executor = ThreadPoolExecutor(1, name, initializer=os.nice, initargs=(niceness,))
        self._current: Future[None] | None = None

    def start(self, work: Callable[[JobBatch], None], batch: JobBatch) -> None:
        """Hand the batch and its lease to the thread; raise what its previous `work` raised."""
        self.wait()
        handed_over = replace(batch, lease=batch.lease.pop_all())
        self._current = self.executor.submit(work, handed_over)

    def wait(self) -> None:
        """Wait until the thread is free; raise what its `work` raised."""
        current, self._current = self._current, None
        if current is not None:
            current.result()


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
        device = choose_device(settings.device).type
        settings = settings.for_device(device)
        self._metrics = ExtractorMetrics(registry or CollectorRegistry())
        self._heartbeat = Heartbeat(settings.heartbeat_file)
        self._only_worker = only_worker
        self._stop = threading.Event()  # replaced by that of the caller, when there are jobs

        def is_stopping() -> bool:
            return self._stop.is_set()

        load_added = AddedModelLoader(catalog, store, settings, is_stopping).load
        models = ModelRegistry(
            store, settings, load_added, self._metrics.model_load_seconds.observe
        )
        self.context = ExtractorContext(
            catalog, store, settings, models, decoders or DecoderPool(settings), is_stopping
        )
        on_outcome = self._metrics.count_step_outcome
        self.fits = FitWorker(self.context, name, on_outcome, compute_fit, wakeups)
        self._runner = JobRunner(catalog, settings, name, DRAINED_JOBS, on_outcome, wakeups)
        niceness = BATCH_NICENESS if device == "cpu" and sys.platform == "linux" else 0
        self._describing, self._publishing = Stage("describe", niceness), Stage("publish")
        self._queries = ThreadPoolExecutor(max_workers=1, thread_name_prefix="queries")
        self._query_lock = threading.Lock()  # held while a query, or an exclusive job, runs
        self._extractors = PolledValue(
            (lambda: 1) if only_worker else self._count_extractors, PROCESS_HEARTBEAT_SECONDS
        )

    def state(self) -> dict[str, Any]:
        """Return the device, and the models with their errors, as the process registers them."""
        return self.context.models.state

    def warm_up(self, stop: threading.Event) -> None:
        """Load the extractor of new maps, so that the first photo does not wait for it."""
        self._stop = stop
        try:
            self.context.models.extractor(self.context.settings.new_map_extractor)
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
        for executor in (self._describing.executor, self._publishing.executor, self._queries):
            executor.shutdown()
        self.context.decoders.close()

    def drain(self, stop: threading.Event) -> bool:
        """Process jobs until none is claimable, or `stop` is set; return whether there was one."""
        self._stop = stop
        self._heartbeat.beat()
        batch = self._claim() if self._runner.has_jobs() else None  # most looks find none
        if batch is None:
            return False
        with self._metrics.draining.track_inprogress(), self._answering_queries():
            try:
                while batch is not None:
                    # Without the catalog, claimed jobs are requeued when their lease expires.
                    with batch.lease:
                        self._process(batch)
                    batch = self._claim_unless_stopping()
                    if batch is None:
                        self._wait_for_stages()  # which may requeue jobs
                        batch = self._claim_unless_stopping()
            finally:
                self._wait_for_stages()
        return True

    def _claim_unless_stopping(self) -> JobBatch | None:
        return None if self._stop.is_set() else self._claim()

    def _wait_for_stages(self) -> None:
        try:
            self._describing.wait()
        finally:
            self._publishing.wait()

    def _claim(self, min_priority: int | None = None, *, alone: bool = True) -> JobBatch | None:
        self._heartbeat.beat()  # for each batch: a drain may last for several
        claimed = self._runner.claim(
            self._fair_batch_size(), min_priority, alone=alone, started=False
        )
        if claimed is None:
            return None
        self._metrics.batch_jobs.labels(claimed.kind).observe(len(claimed.jobs))
        batch = JobBatch(claimed.jobs, claimed.lease)
        batch.stages = HANDLERS[batch.kind](self.context, batch)
        return batch

    def _fair_batch_size(self) -> int:
        limit, workers = self.context.settings.batch_photos, self._extractors.get()
        waiting = self._runner.count_waiting(2 * workers * limit) if workers > 1 else 0
        return fair_batch_size(waiting, workers, limit)

    def _count_extractors(self) -> int:
        with self.context.catalog.read() as session:
            found = list_processes(session)
        return sum(process.role == "extractor" and process.is_live for process in found)

    def _process(self, batch: JobBatch) -> None:
        """Decode a batch and hand it on, or run all of its stages here."""
        # Nothing may run beside it, so that a crash can be attributed to the job.
        if batch.jobs[0].alone or batch.kind in SINGLE_CLAIM_JOBS:
            self._wait_for_stages()
            with self._query_lock:
                self._run(batch, concurrent_jobs=0)
        elif batch.jobs[0].priority >= Priority.QUERY:
            self._run(batch)
        elif self._run_stage(batch):
            self._describing.wait()
            if self._stop.is_set():
                self._runner.requeue(batch)
            else:
                self._describing.start(self._describe_and_hand_on, batch)

    def _describe_and_hand_on(self, batch: JobBatch) -> None:
        with batch.lease:
            if self._describe(batch):
                self._publishing.start(self._publish, batch)

    def _publish(self, batch: JobBatch) -> None:
        with batch.lease:
            self._run_stage(batch)

    def _run(self, batch: JobBatch, concurrent_jobs: int = 1) -> None:
        """Run all stages of a batch in this thread."""
        with batch.lease:
            if self._run_stage(batch) and self._describe(batch, concurrent_jobs):
                self._run_stage(batch)

    def _describe(self, batch: JobBatch, concurrent_jobs: int = 1) -> bool:
        """Run the stage that needs the model; of `concurrent_jobs`, any may cause a crash, too."""

        def mark_jobs() -> None:
            # From here on a crash may be caused by a photo: decoding ran in other processes.
            with self.context.catalog.write() as session:
                mark_started(session, batch.token, len(batch.jobs) + concurrent_jobs)
            self._runner.report_started(batch)

        return self._run_stage(batch, mark_jobs)

    def _run_stage(self, batch: JobBatch, begin: Callable[[], None] = lambda: None) -> bool:
        """Run the batch's next stage; return whether one follows."""
        with self._runner.step(batch):
            begin()
            if next(batch.stages, DONE) is not DONE:
                return True
        self._metrics.observe_batch(batch)
        self._runner.report_ended(batch)
        return False

    @contextlib.contextmanager
    def _answering_queries(self) -> Iterator[None]:
        """Answer queries in a thread of their own while the block runs."""
        done = threading.Event()
        answered = self._queries.submit(self._answer_queries, done)
        try:
            yield
        finally:
            done.set()
            self.context.catalog.commits.count_one()  # ends the thread's wait
            answered.result()

    def _answer_queries(self, done: threading.Event) -> None:
        commits = self.context.catalog.commits
        while not (done.is_set() or self._stop.is_set()):
            query, seen = None, commits.count
            with self._query_lock:
                if self._runner.has_jobs(Priority.QUERY, alone=False):
                    query = self._claim(Priority.QUERY, alone=False)
                if query is not None:
                    self._run(query)
            if query is None and not done.wait(QUERY_PAUSE_SECONDS):
                commits.wait(seen, IDLE_POLL_SECONDS)
