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

from services.extractor.added_models import AddedModels
from services.extractor.compare import Comparisons, Prepared
from services.extractor.decoding import DecoderPool
from services.extractor.describe import describe
from services.extractor.drain_result import DrainResult
from services.extractor.loaded import LoadedModels
from services.extractor.metrics import ExtractorMetrics
from services.extractor.model_change import ModelChanges
from services.extractor.prepare import Batch, prepare
from services.extractor.publish import Published, publish
from services.extractor.renew import renew_outdated_generations
from services.extractor.setbacks import AWAY_SECONDS, Setbacks
from services.extractor.target import find_target
from shared.catalog.away import Outage
from shared.catalog.session import Catalog
from shared.chunks import Rows
from shared.errors import PlacewiseError
from shared.heartbeat import Heartbeat
from shared.jobs import InProcessHints, Job, Priority, begin, claim, hold_lease
from shared.jobs.claim import any_claimable
from shared.jobs.leases import token_of
from shared.jobs.on_behalf import on_behalf_of
from shared.jobs.table import EXTRACTOR_JOBS, MODEL_CHANGES, JobKind
from shared.objects import ObjectStore
from shared.settings import Settings

log = logging.getLogger(__name__)

QUERY_LOOK_SECONDS = 0.1  # between two looks for queries while a bulk batch is described
IDLE_SECONDS = 1.0  # how long a lost hint can cost


@dataclass(slots=True)
class Work:
    """Claimed jobs, the lease that keeps them, and their photos being decoded."""

    jobs: list[Job]
    lease: contextlib.ExitStack
    batch: Future[Batch | Prepared | None] | None
    """None inside: the map has no vocabulary yet. None itself: a slice of a model change, or a
    checkpoint to look at."""

    @property
    def token(self) -> UUID:
        return token_of(self.jobs[0])


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
        added = AddedModels(catalog, store, settings)
        self._models = LoadedModels(store, settings, added.load, self._metrics.loaded)
        self._decoders = DecoderPool(settings)
        self._changes = ModelChanges(catalog, store, self._models, self._decoders, settings)
        self._comparisons = Comparisons(catalog, store, self._models, self._decoders, settings)
        self._setbacks = Setbacks(catalog, settings.max_attempts, self._metrics)
        # Two: a query's photo does not wait until those of the next batch are read.
        self._ahead = ThreadPoolExecutor(max_workers=2, thread_name_prefix="prepare")
        self._beside = ThreadPoolExecutor(max_workers=1, thread_name_prefix="queries")
        self._publisher = ThreadPoolExecutor(max_workers=1, thread_name_prefix="publish")
        self._behind: Future[DrainResult] | None = None

    def warm_up(self) -> None:
        """Load the extractor of new maps, so that the first photo does not wait for it."""
        try:
            self._models.extractor(self._settings.new_map_extractor)
        except PlacewiseError as error:
            # Maps may use another one; photos that need this one will say the same.
            log.error("the extractor of new maps can't be loaded: %s", error.detail)
        if self._only_worker:
            renew_outdated_generations(self._catalog, self._models)

    def run(self, stop: threading.Event, hints: InProcessHints) -> None:
        """Drain whenever there is work, until `stop` is set: the embedded worker's life."""
        self.warm_up()
        outage = Outage("extractor")
        while not stop.is_set():
            try:
                result = self.drain(stop)
            except SQLAlchemyError as error:
                outage.met(error)
                stop.wait(AWAY_SECONDS)
                continue
            outage.over()
            if result.claimed:
                log.info("drained: %s", result.as_dict())
            else:
                hints.wait(IDLE_SECONDS)

    def close(self) -> None:
        """End the decoders; what is claimed comes back when its lease expires."""
        self._beside.shutdown(wait=True)
        self._publisher.shutdown(wait=True)
        self._ahead.shutdown(wait=True, cancel_futures=True)
        self._decoders.close()

    def drain(self, stop: threading.Event, seconds: float = math.inf) -> DrainResult:
        """Work until nothing is claimable, `stop` is set, or `seconds` have passed."""
        result = DrainResult()
        ahead = self._take(result)
        if ahead is not None:
            with self._metrics.draining():
                self._drain(ahead, stop, time.monotonic() + seconds, result)
        return result

    def _drain(self, first: Work, stop: threading.Event, until: float, result: DrainResult) -> None:
        work: Work | None = None
        ahead: Work | None = first

        def time_is_up() -> bool:
            return stop.is_set() or time.monotonic() > until

        try:
            while ahead is not None:
                if time_is_up():
                    with ahead.lease:
                        self._setbacks.give_back(ahead.jobs)
                    result.more = True
                    break
                work = ahead
                # Taken before the forward pass: the next photos are decoded while it runs.
                ahead = self._take(result)
                if not _is_query(work):
                    # A query would wait for the batch, and for the one that is being published.
                    while ahead is not None and _is_query(ahead) and not time_is_up():
                        self._go_on_with(ahead, result, stop)
                        ahead = self._take(result)
                self._go_on_with(work, result, stop)
                if ahead is None:
                    self._await_published(result)  # which may set jobs free again
                    ahead = self._take(result)
        finally:
            # The catalog may be away: what is held then comes back when its lease expires.
            for unfinished in (work, ahead):
                if unfinished is not None:
                    unfinished.lease.close()
            self._await_published(result)

    def _go_on_with(self, work: Work, result: DrainResult, stop: threading.Event) -> None:
        if _has_to_be_alone(work):
            self._await_published(result)
            self._do(work, result)
        elif _is_query(work):
            self._do(work, result, company=0 if self._behind is None else 1)
        else:
            with self._queries_beside(result, stop):
                self._do(work, result, company=1, behind=True)

    @contextlib.contextmanager
    def _queries_beside(self, result: DrainResult, stop: threading.Event) -> Iterator[None]:
        """While the block describes a bulk batch, queries are described in another thread."""
        done, seen = threading.Event(), DrainResult()
        queries = self._beside.submit(self._answer_queries, done, stop, seen)
        try:
            yield
        finally:
            done.set()
            wait([queries])
            result.add(seen)
        queries.result()

    def _answer_queries(
        self, done: threading.Event, stop: threading.Event, result: DrainResult
    ) -> None:
        while not (done.is_set() or stop.is_set()):
            with self._catalog.read() as session:
                asked = any_claimable(session, EXTRACTOR_JOBS, Priority.QUERY, alone=False)
            query = (
                self._take(result, least_priority=Priority.QUERY, alone=False) if asked else None
            )
            if query is None:
                done.wait(QUERY_LOOK_SECONDS)
            else:
                self._do(query, result, company=1)

    def _take(
        self, result: DrainResult, least_priority: int | None = None, *, alone: bool = True
    ) -> Work | None:
        settings = self._settings
        self._heartbeat.beat()  # before and after each batch: a drain may last for several
        with self._catalog.write() as session:
            jobs = claim(
                session,
                worker=self._name,
                limit=settings.batch_photos,
                lease_seconds=settings.lease_seconds,
                least_priority=least_priority,
                alone=alone,
                begun=False,
            )
        if not jobs:
            return None
        self._metrics.claimed(JobKind(jobs[0].kind), len(jobs))
        result.claimed += len(jobs)
        result.maps.add(str(jobs[0].map_id))
        work = Work(jobs, contextlib.ExitStack(), None)
        work.lease.enter_context(hold_lease(self._catalog, work.token, settings.lease_seconds))
        if jobs[0].kind == JobKind.COMPARE:
            work.batch = self._ahead.submit(self._comparisons.prepare, jobs[0])
        elif jobs[0].kind not in (JobKind.ADD_MODEL, *MODEL_CHANGES):
            work.batch = self._ahead.submit(self._prepare, jobs)
        return work

    def _prepare(self, jobs: list[Job]) -> Batch | None:
        with on_behalf_of(jobs, "prepare"):
            target = find_target(self._catalog, self._store, self._models, jobs[0])
            if target is None:
                return None
            return prepare(self._catalog, self._store, self._decoders, jobs, target)

    def _do(
        self, work: Work, result: DrainResult, company: int = 0, *, behind: bool = False
    ) -> None:
        """`company`: so many others may be under way beside it, and share the blame for a fall.
        `behind`: it may be published while the model has the next one.
        """
        with work.lease:
            rows = self._describe(work, result, company)
            if rows is None:
                return
            if not behind:
                self._publish(work, rows, result)
                return
            self._await_published(result)
            moved = replace(work, lease=work.lease.pop_all())
            self._behind = self._publisher.submit(self._publish_behind, moved, rows)

    def _describe(self, work: Work, result: DrainResult, company: int) -> Rows | None:
        """A row for each of the batch's `ready`; None where there is nothing to publish."""
        with on_behalf_of(work.jobs, "describe"), self._setbacks.answered(work.jobs, result):
            if work.batch is None:
                started = time.perf_counter()
                self._begin(work)
                self._changes.slice(work.jobs[0])
                took = time.perf_counter() - started
                result.seconds["model change"] += took
                self._metrics.stage("model change", took)
                return None
            batch = work.batch.result()
            if batch is None:
                self._setbacks.wait_for_vocabulary(work.jobs)
                return None
            self._begin(work, company)
            if isinstance(batch, Prepared):
                self._count(work, result, self._comparisons.finish(batch), batch.seconds)
                return None
            return describe(batch)
        return None  # what went wrong has been answered

    def _publish(self, work: Work, rows: Rows, result: DrainResult) -> None:
        with on_behalf_of(work.jobs, "publish"), self._setbacks.answered(work.jobs, result):
            batch = work.batch.result() if work.batch else None
            assert isinstance(batch, Batch), "it was described"
            outcome = publish(self._catalog, self._store, batch, rows, self._settings.slot_rows)
            self._count(work, result, outcome, batch.seconds)

    def _count(
        self, work: Work, result: DrainResult, outcome: Published, seconds: dict[str, float]
    ) -> None:
        result.count(outcome, seconds)
        self._metrics.published(JobKind(work.jobs[0].kind), outcome, seconds)

    def _publish_behind(self, work: Work, rows: Rows) -> DrainResult:
        result = DrainResult()
        with work.lease:
            self._publish(work, rows, result)
        return result

    def _await_published(self, result: DrainResult) -> None:
        """Until nothing is being published behind the model; what it came to is counted."""
        behind, self._behind = self._behind, None
        if behind is not None:
            result.add(behind.result())

    def _begin(self, work: Work, company: int = 0) -> None:
        """Decoding, in other processes, is done: a fall from here on may be the photos' fault."""
        with self._catalog.write() as session:
            begin(session, work.token, len(work.jobs) + company)


def _is_query(work: Work) -> bool:
    return work.jobs[0].priority >= Priority.QUERY


def _has_to_be_alone(work: Work) -> bool:
    """Else nobody knows who felled the worker. Model changes come as a batch of one, too."""
    return work.batch is None or work.jobs[0].alone
