"""The worker: drains the job table, one batch after the other, queries first.

    claim ──> read, decode ──> forward pass, aggregate ──> chunk, transaction
              batch n + 1      batch n                      batch n - 1

Bulk batches overlap: while one is on the model the next one is read and decoded and the one before
is published. One is at each of the three places, no more: a batch that has been described waits
until the one before is published. Its lease is kept through all of them, up to the transaction.

A query that arrives while a batch is described is described beside it; where that can't be, it goes
before the next bulk batch, so that it waits for one batch at most. Its row is published at once, in
the thread that described it.

Jobs that are tried alone, to find out who felled a worker, and slices of model changes overlap with
nothing: what was described before is published first.
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
from uuid import UUID

from prometheus_client import CollectorRegistry
from sqlalchemy.exc import SQLAlchemyError

from services.extractor.added_models import AddedModelLoader
from services.extractor.comparison import ComparisonRunner, PreparedComparison
from services.extractor.decoder_pool import DecoderPool
from services.extractor.failures import UNAVAILABLE_RETRY_SECONDS, JobFailureHandler
from services.extractor.generation_resolver import reindex_outdated_generations, resolve_generation
from services.extractor.metrics import DrainStats, ExtractorMetrics
from services.extractor.model_changes import ModelChangeRunner
from services.extractor.model_registry import ModelRegistry
from services.extractor.prepare import DescribeBatch, describe_batch, prepare_batch
from services.extractor.publish import PublishResult, publish
from shared.catalog.database_errors import OutageLog
from shared.catalog.jobs import EXTRACTOR_JOBS, MODEL_CHANGE_JOBS, JobKind
from shared.catalog.session import Catalog
from shared.config.settings import Settings
from shared.errors import PlacewiseError
from shared.jobs import InProcessWakeups, Job, Priority, claim_jobs, maintain_lease, mark_started
from shared.jobs.claim import has_claimable_jobs
from shared.jobs.leases import get_lease_token
from shared.jobs.trace_context import job_trace_context
from shared.storage import ObjectStore
from shared.storage.chunks import Rows
from shared.telemetry.heartbeat import Heartbeat

log = logging.getLogger(__name__)

QUERY_POLL_SECONDS = 0.1  # between two looks for queries while a bulk batch is described
IDLE_POLL_SECONDS = 1.0  # how long a lost hint can cost


@dataclass(slots=True)
class ClaimedJobs:
    """Claimed jobs, the lease that keeps them, and their photos being decoded."""

    jobs: list[Job]
    lease: contextlib.ExitStack
    preparation: Future[DescribeBatch | PreparedComparison | None] | None
    """None inside: the map has no vocabulary yet. None itself: a slice of a model change, or a
    checkpoint to look at."""

    @property
    def token(self) -> UUID:
        return get_lease_token(self.jobs[0])


class ExtractorWorker:
    """One per GPU (or per process on CPU). `run` until stopped, or `drain` once per hint."""

    def __init__(
        self,
        catalog: Catalog,
        store: ObjectStore,
        settings: Settings,
        name: str,
        *,
        only_worker: bool = False,
        registry: CollectorRegistry | None = None,
    ) -> None:
        """`only_worker`: no other can be of another release, so this one renews what is old.
        `registry`: of the process's figures."""
        self._metrics = ExtractorMetrics(registry or CollectorRegistry())
        self._catalog = catalog
        self._store = store
        self._settings = settings
        self._heartbeat = Heartbeat(settings.heartbeat_file)
        self._name = name
        self._only_worker = only_worker
        added = AddedModelLoader(catalog, store, settings)
        self._models = ModelRegistry(store, settings, added.load, self._metrics.observe_model_load)
        self._decoders = DecoderPool(settings)
        self._model_changes = ModelChangeRunner(
            catalog, store, self._models, self._decoders, settings
        )
        self._comparisons = ComparisonRunner(catalog, store, self._models, self._decoders, settings)
        self._failures = JobFailureHandler(catalog, settings.max_attempts, self._metrics)
        # Two: a query's photo does not wait until those of the next batch are read.
        self._prepare_executor = ThreadPoolExecutor(max_workers=2, thread_name_prefix="prepare")
        self._query_executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="queries")
        self._publish_executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="publish")
        self._pending_publish: Future[DrainStats] | None = None

    def warm_up(self) -> None:
        """Load the extractor of new maps, so that the first photo does not wait for it."""
        try:
            self._models.extractor(self._settings.new_map_extractor)
        except PlacewiseError as error:
            # Maps may use another one; photos that need this one will say the same.
            log.error("the extractor of new maps can't be loaded: %s", error.detail)
        if self._only_worker:
            reindex_outdated_generations(self._catalog, self._models)

    def run(self, stop: threading.Event, hints: InProcessWakeups) -> None:
        """Drain whenever there is work, until `stop` is set: the embedded worker's life."""
        self.warm_up()
        outage = OutageLog("extractor")
        while not stop.is_set():
            try:
                result = self.drain(stop)
            except SQLAlchemyError as error:
                outage.record_error(error)
                stop.wait(UNAVAILABLE_RETRY_SECONDS)
                continue
            outage.record_success()
            if result.claimed:
                log.info("drained: %s", result.as_dict())
            else:
                hints.wait(IDLE_POLL_SECONDS)

    def close(self) -> None:
        """End the decoders; what is claimed comes back when its lease expires."""
        self._query_executor.shutdown(wait=True)
        self._publish_executor.shutdown(wait=True)
        self._prepare_executor.shutdown(wait=True, cancel_futures=True)
        self._decoders.close()

    def drain(self, stop: threading.Event, seconds: float = math.inf) -> DrainStats:
        """Work until nothing is claimable, `stop` is set, or `seconds` have passed."""
        result = DrainStats()
        ahead = self._claim_next(result)
        if ahead is not None:
            with self._metrics.measure_drain():
                self._drain(ahead, stop, time.monotonic() + seconds, result)
        return result

    def _drain(
        self, first: ClaimedJobs, stop: threading.Event, until: float, result: DrainStats
    ) -> None:
        work: ClaimedJobs | None = None
        ahead: ClaimedJobs | None = first

        def time_is_up() -> bool:
            return stop.is_set() or time.monotonic() > until

        try:
            while ahead is not None:
                if time_is_up():
                    with ahead.lease:
                        self._failures.release_unstarted(ahead.jobs)
                    result.interrupted = True
                    break
                work = ahead
                # Taken before the forward pass: the next photos are decoded while it runs.
                ahead = self._claim_next(result)
                if not _is_query(work):
                    # A query would wait for the batch, and for the one that is being published.
                    while ahead is not None and _is_query(ahead) and not time_is_up():
                        self._process_in_order(ahead, result, stop)
                        ahead = self._claim_next(result)
                self._process_in_order(work, result, stop)
                if ahead is None:
                    self._wait_for_publish(result)  # which may set jobs free again
                    ahead = self._claim_next(result)
        finally:
            # The catalog may be away: what is held then comes back when its lease expires.
            for unfinished in (work, ahead):
                if unfinished is not None:
                    unfinished.lease.close()
            self._wait_for_publish(result)

    def _process_in_order(
        self, work: ClaimedJobs, result: DrainStats, stop: threading.Event
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
        """While the block describes a bulk batch, queries are described in another thread."""
        done, seen = threading.Event(), DrainStats()
        queries = self._query_executor.submit(self._poll_queries, done, stop, seen)
        try:
            yield
        finally:
            done.set()
            wait([queries])
            result.merge(seen)
        queries.result()

    def _poll_queries(
        self, done: threading.Event, stop: threading.Event, result: DrainStats
    ) -> None:
        while not (done.is_set() or stop.is_set()):
            with self._catalog.read() as session:
                asked = has_claimable_jobs(session, EXTRACTOR_JOBS, Priority.QUERY, alone=False)
            query = (
                self._claim_next(result, least_priority=Priority.QUERY, alone=False)
                if asked
                else None
            )
            if query is None:
                done.wait(QUERY_POLL_SECONDS)
            else:
                self._process(query, result, concurrent_jobs=1)

    def _claim_next(
        self, result: DrainStats, least_priority: int | None = None, *, alone: bool = True
    ) -> ClaimedJobs | None:
        settings = self._settings
        self._heartbeat.beat()  # before and after each batch: a drain may last for several
        with self._catalog.write() as session:
            jobs = claim_jobs(
                session,
                worker=self._name,
                limit=settings.batch_photos,
                lease_seconds=settings.lease_seconds,
                min_priority=least_priority,
                alone=alone,
                started=False,
            )
        if not jobs:
            return None
        self._metrics.observe_claim(JobKind(jobs[0].kind), len(jobs))
        result.claimed += len(jobs)
        result.maps.add(str(jobs[0].map_id))
        work = ClaimedJobs(jobs, contextlib.ExitStack(), None)
        work.lease.enter_context(maintain_lease(self._catalog, work.token, settings.lease_seconds))
        if jobs[0].kind == JobKind.COMPARE:
            work.preparation = self._prepare_executor.submit(self._comparisons.prepare, jobs[0])
        elif jobs[0].kind not in (JobKind.ADD_MODEL, *MODEL_CHANGE_JOBS):
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
        work: ClaimedJobs,
        result: DrainStats,
        concurrent_jobs: int = 0,
        *,
        publish_async: bool = False,
    ) -> None:
        """`concurrent_jobs`: so many others may be under way beside it, and share the blame for
        a fall.
        `publish_async`: it may be published while the model has the next one.
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
        self, work: ClaimedJobs, result: DrainStats, concurrent_jobs: int
    ) -> Rows | None:
        """A row for each of the batch's `ready`; None where there is nothing to publish."""
        with (
            job_trace_context(work.jobs, "describe"),
            self._failures.handling_failures(work.jobs, result),
        ):
            if work.preparation is None:
                started = time.perf_counter()
                self._mark_begun(work)
                self._model_changes.run_step(work.jobs[0])
                took = time.perf_counter() - started
                result.seconds["model change"] += took
                self._metrics.observe_stage("model change", took)
                return None
            batch = work.preparation.result()
            if batch is None:
                self._failures.defer_until_vocabulary(work.jobs)
                return None
            self._mark_begun(work, concurrent_jobs)
            if isinstance(batch, PreparedComparison):
                self._record_outcome(work, result, self._comparisons.run(batch), batch.seconds)
                return None
            return describe_batch(batch)
        return None  # what went wrong has been answered

    def _publish(self, work: ClaimedJobs, rows: Rows, result: DrainStats) -> None:
        with (
            job_trace_context(work.jobs, "publish"),
            self._failures.handling_failures(work.jobs, result),
        ):
            batch = work.preparation.result() if work.preparation else None
            assert isinstance(batch, DescribeBatch), "it was described"
            outcome = publish(self._catalog, self._store, batch, rows, self._settings.slot_rows)
            self._record_outcome(work, result, outcome, batch.seconds)

    def _record_outcome(
        self,
        work: ClaimedJobs,
        result: DrainStats,
        outcome: PublishResult,
        seconds: dict[str, float],
    ) -> None:
        result.add_batch(outcome, seconds)
        self._metrics.observe_batch(JobKind(work.jobs[0].kind), outcome, seconds)

    def _publish_in_background(self, work: ClaimedJobs, rows: Rows) -> DrainStats:
        result = DrainStats()
        with work.lease:
            self._publish(work, rows, result)
        return result

    def _wait_for_publish(self, result: DrainStats) -> None:
        """Until nothing is being published behind the model; what it came to is counted."""
        behind, self._pending_publish = self._pending_publish, None
        if behind is not None:
            result.merge(behind.result())

    def _mark_begun(self, work: ClaimedJobs, concurrent_jobs: int = 0) -> None:
        """Decoding, in other processes, is done: a fall from here on may be the photos' fault."""
        with self._catalog.write() as session:
            mark_started(session, work.token, len(work.jobs) + concurrent_jobs)


def _is_query(work: ClaimedJobs) -> bool:
    return work.jobs[0].priority >= Priority.QUERY


def _runs_exclusively(work: ClaimedJobs) -> bool:
    """Else nobody knows who felled the worker. Model changes come as a batch of one, too."""
    return work.preparation is None or work.jobs[0].alone
