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
from collections import defaultdict
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field, replace
from typing import Any
from uuid import UUID

import numpy as np
from sqlalchemy.exc import SQLAlchemyError

from services.extractor.added_models import AddedModels
from services.extractor.compare import Comparisons, Prepared
from services.extractor.decoding import DecoderPool
from services.extractor.loaded import LoadedModels
from services.extractor.model_change import ModelChanges
from services.extractor.prepare import Batch, prepare
from services.extractor.publish import Published, publish
from services.extractor.renew import renew_outdated_generations
from services.extractor.target import find_target
from shared.catalog.away import Outage
from shared.catalog.generations import active_generation
from shared.catalog.maps import lock_map
from shared.catalog.session import Catalog
from shared.chunks import Rows
from shared.errors import Conflict, PlacewiseError, Unavailable
from shared.heartbeat import Heartbeat
from shared.jobs import InProcessHints, Job, Priority, begin, claim, hold_lease
from shared.jobs.claim import any_claimable
from shared.jobs.finish import fail, release
from shared.jobs.leases import fallen, held
from shared.jobs.model_changes import abandon_generation
from shared.jobs.table import EXTRACTOR_JOBS, MODEL_CHANGES, JobKind, WaitingFor
from shared.objects import ObjectStore
from shared.settings import Settings
from shared.vision.passes import PhotoDoesNotFit

log = logging.getLogger(__name__)

QUERY_LOOK_SECONDS = 0.1  # between two looks for queries while a bulk batch is described
IDLE_SECONDS = 1.0  # how long a lost hint can cost
AWAY_SECONDS = 2.0  # pause of jobs when the store or the catalog is not there right now
OPERATOR_SECONDS = 15.0  # pause of photos that need an operator first (weights missing, say)


@dataclass(slots=True)
class DrainResult:
    """What one drain did: this is what the operator sees."""

    maps: set[str] = field(default_factory=set)
    claimed: int = 0
    succeeded: int = 0
    failed: int = 0
    seconds: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))
    more: bool = False
    """It ended before the work did."""

    def add(self, other: DrainResult) -> None:
        """Count what another one has counted, too."""
        self.maps |= other.maps
        self.claimed += other.claimed
        self.succeeded += other.succeeded
        self.failed += other.failed
        for stage, took in other.seconds.items():
            self.seconds[stage] += took

    def as_dict(self) -> dict[str, Any]:
        """For logs and for Flower."""
        return {
            "maps": sorted(self.maps),
            "claimed": self.claimed,
            "succeeded": self.succeeded,
            "failed": self.failed,
            "seconds": {stage: round(took, 3) for stage, took in self.seconds.items()},
        }


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
        token = self.jobs[0].lease_token
        assert token is not None, "a claimed job carries a token"
        return token


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
    ) -> None:
        """`only_worker`: no other can be of another release, so this one renews what is old."""
        self._catalog = catalog
        self._store = store
        self._settings = settings
        self._heartbeat = Heartbeat(settings.heartbeat_file)
        self._name = name
        self._only_worker = only_worker
        self._models = LoadedModels(store, settings, AddedModels(catalog, store, settings).load)
        self._decoders = DecoderPool(settings)
        self._changes = ModelChanges(catalog, store, self._models, self._decoders, settings)
        self._comparisons = Comparisons(catalog, store, self._models, self._decoders, settings)
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
        until = time.monotonic() + seconds
        work: Work | None = None
        ahead = self._take(result)
        try:
            while ahead is not None:
                if stop.is_set() or time.monotonic() > until:
                    self._give_back(ahead)
                    result.more = True
                    break
                work = ahead
                if work.jobs[0].priority < Priority.QUERY:
                    query = self._take(result, least_priority=Priority.QUERY)
                    if query is not None:
                        self._go_on_with(query, result, stop)
                # Taken before the forward pass: the next photos are decoded while it runs.
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
        return result

    def _go_on_with(self, work: Work, result: DrainResult, stop: threading.Event) -> None:
        if _has_to_be_alone(work):
            self._await_published(result)
            self._do(work, result)
        elif work.jobs[0].priority >= Priority.QUERY:
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
        with self._answered(work, result):
            if work.batch is None:
                started = time.perf_counter()
                self._begin(work)
                self._changes.slice(work.jobs[0])
                result.seconds["model change"] += time.perf_counter() - started
                return None
            batch = work.batch.result()
            if batch is None:
                self._wait_for_vocabulary(work)
                return None
            self._begin(work, company)
            if isinstance(batch, Prepared):
                self._count(self._comparisons.finish(batch), batch.seconds, result)
                return None
            return _rows(batch)
        return None  # what went wrong has been answered

    def _publish(self, work: Work, rows: Rows, result: DrainResult) -> None:
        with self._answered(work, result):
            batch = work.batch.result() if work.batch else None
            assert isinstance(batch, Batch), "it was described"
            outcome = publish(self._catalog, self._store, batch, rows, self._settings.slot_rows)
            self._count(outcome, batch.seconds, result)

    @staticmethod
    def _count(outcome: Published, seconds: dict[str, float], result: DrainResult) -> None:
        result.succeeded += outcome.succeeded
        result.failed += outcome.failed
        for stage, took in seconds.items():
            result.seconds[stage] += took

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

    @contextlib.contextmanager
    def _answered(self, work: Work, result: DrainResult) -> Iterator[None]:
        """What goes wrong in the block is written to the jobs. Raises what can't be written."""
        try:
            yield
        except (Unavailable, OSError, SQLAlchemyError) as error:
            self._pause(work, error)
        except PlacewiseError as error:
            result.failed += self._refuse(work, error)
        except Exception as error:
            log.exception("a batch of %d jobs crashed", len(work.jobs))
            self._crashed(work, error)

    def _begin(self, work: Work, company: int = 0) -> None:
        """Decoding, in other processes, is done: a fall from here on may be the photos' fault."""
        with self._catalog.write() as session:
            begin(session, work.token, len(work.jobs) + company)

    def _wait_for_vocabulary(self, work: Work) -> None:
        """Photos wait until the map has one; a query is told at once."""
        with self._catalog.write() as session:
            lock_map(session, work.jobs[0].map_id)
            there = active_generation(session, work.jobs[0].map_id) is not None
            for job in held(session, work.token, work.jobs):
                if job.kind == JobKind.DESCRIBE and not there:
                    fail(job, no_vocabulary().as_problem())
                else:
                    release(job, waiting_for=None if there else WaitingFor.VOCABULARY)

    def _give_back(self, work: Work) -> None:
        """Stopping: what was taken ahead goes to another worker, unharmed."""
        with work.lease, self._catalog.write() as session:
            for job in held(session, work.token, work.jobs):
                release(job)

    def _pause(self, work: Work, error: Exception) -> None:
        """Something outside the jobs is away: try again soon, and count no attempt."""
        log.warning("%d jobs pause for %g s: %s", len(work.jobs), AWAY_SECONDS, error)
        with self._catalog.write() as session:
            for job in held(session, work.token, work.jobs):
                release(job, after_seconds=AWAY_SECONDS)
                job.error = error.as_problem() if isinstance(error, PlacewiseError) else None

    def _refuse(self, work: Work, error: PlacewiseError) -> int:
        """The request can't be met. Stored photos wait for the operator, all else fails."""
        log.error("%s", error.detail)
        failed = 0
        with self._catalog.write() as session:
            for job in held(session, work.token, work.jobs):
                if job.kind in (JobKind.INDEX, JobKind.REINDEX):
                    release(job, after_seconds=OPERATOR_SECONDS)
                    job.error = error.as_problem()
                    continue
                fail(job, error.as_problem())
                failed += 1
                abandon_generation(session, job)
        return failed

    def _crashed(self, work: Work, error: Exception) -> None:
        """As if the worker had died: what fell in a batch is tried alone, then counted."""
        with self._catalog.write() as session:
            for job in held(session, work.token, work.jobs):
                job.claimed_together = len(work.jobs)
                fallen(
                    session,
                    job,
                    self._settings.max_attempts,
                    cause=type(error).__name__,
                )


def _rows(batch: Batch) -> Rows:
    """A row for each of the batch's `ready`, which photos that the GPU can't hold have left."""
    target = batch.target
    while batch.ready:
        started = time.perf_counter()
        try:
            if batch.stored is not None:
                assert target.projection is not None
                rows = target.projection.project(batch.stored)
            else:
                pixels = batch.pixels()
                rows = target.extractor.describe(pixels, target.centres, target.projection)
        except PhotoDoesNotFit as error:
            batch.refuse(error.place, error)
            continue
        batch.seconds["describe"] = time.perf_counter() - started
        return rows
    return np.empty((0, target.generation.dimension), np.float32)


def _has_to_be_alone(work: Work) -> bool:
    """Else nobody knows who felled the worker. Model changes come as a batch of one, too."""
    return work.batch is None or work.jobs[0].alone


def no_vocabulary() -> Conflict:
    return Conflict(
        "no_vocabulary",
        "The map's extractor needs a vocabulary and the map has none yet. Fit one on its photos "
        "(POST /api/v1/vocabularies) or import one (POST /api/v1/vocabularies/import).",
    )
