"""The steward's scheduler: runs each periodic maintenance task at its interval.

Short tasks share one thread. A task that reads a whole map or the whole store has its own.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, cast

from prometheus_client import CollectorRegistry
from sqlalchemy.exc import SQLAlchemyError

from services.steward.batches.worker import cancel_items_of_ended_batches, resume_batches
from services.steward.metrics import StewardMetrics
from services.steward.tasks.auto_evaluation import evaluate_changed_maps
from services.steward.tasks.auto_fit import fit_due_vocabularies
from services.steward.tasks.compaction import merge_small_chunks
from services.steward.tasks.delete_maps import purge_deleted_maps
from services.steward.tasks.garbage_collection import collect_garbage
from services.steward.tasks.generation_repair import repair_generations
from services.steward.tasks.journal import JournalTask
from services.steward.tasks.maintenance import (
    delete_expired_idempotency_keys,
    delete_old_deliveries,
    delete_old_jobs,
    delete_old_searches,
    delete_old_tracks,
    reclaim_leases,
    resend_wakeups,
    update_statistics_of_large_maps,
)
from services.steward.tasks.model_changes import (
    advance_model_changes,
    remove_dead_search_workers,
)
from services.steward.tasks.orphans import (
    CollectionHeld,
    collect_orphans,
    empty_expired_trash,
)
from services.steward.tasks.reindex_jobs import QueuedChunks, cancel_jobs_of_abandoned_generations
from shared.catalog.database.errors import OutageLog
from shared.catalog.database.schema import sqlite_file
from shared.catalog.database.session import IDLE_SECONDS, Catalog, ChangePoll
from shared.config.disk_space import DiskReserve
from shared.config.settings import Settings
from shared.jobs import Wakeups
from shared.storage import ObjectStore, OwnedStore
from shared.storage.read_retries import ReadRetries
from shared.telemetry.heartbeat import Heartbeat

log = logging.getLogger(__name__)


class _DeletionCountingStore:
    """Forwards to an object store and calls `on_delete` after each deletion."""

    def __init__(self, store: ObjectStore, on_delete: Callable[[], object]) -> None:
        self._store = store
        self._on_delete = on_delete

    def __getattr__(self, name: str) -> Any:
        return getattr(self._store, name)

    def delete(self, key: str) -> None:
        self._store.delete(key)
        self._on_delete()


SCHEDULER_TICK_SECONDS = 0.25
# Objects in the trash are deleted before the gateway rejects uploads (MIN_FREE_BYTES).
FREE_TRASH_FACTOR = 2


@dataclass(slots=True)
class PeriodicTask:
    """A maintenance task of the scheduler."""

    name: str
    """What it does, as a verb phrase: also the metrics' label, with underscores."""
    interval_seconds: float
    """Pause between the end of a run and the next one."""
    run: Callable[[], object]
    """Returns True if the passing of time makes more work due; else a commit has to."""
    own_thread: bool = False
    """Whether it can take so long that the others must not wait for it."""
    uses_catalog: bool = True
    """Whether its success shows that the catalog can be reached."""
    next_run: float = field(default=0.0)
    """By `time.monotonic`."""
    commits_seen: int = field(default=-1)
    """`CommitSignal.count` before its last run."""


class Scheduler:
    """Runs the periodic tasks when they are due.

    A failed task is logged and runs again after its interval. The heartbeat is that of the thread
    with the short tasks.
    """

    def __init__(
        self,
        catalog: Catalog,
        store: OwnedStore,
        wakeups: Wakeups,
        settings: Settings,
        metrics: StewardMetrics | None = None,
    ) -> None:
        self._metrics = metrics = metrics or StewardMetrics(CollectorRegistry())
        self._catalog = catalog
        self._outage = OutageLog("steward")
        self._heartbeat = Heartbeat(settings.heartbeat_file)
        merge_retries = ReadRetries()
        queued_chunks: QueuedChunks = {}

        def counted(task: str) -> ObjectStore:
            counting = _DeletionCountingStore(store, metrics.objects_deleted.labels(task).inc)
            return cast("ObjectStore", counting)

        # On the disk of the SQLite file; PostgreSQL reserves its own space.
        catalog_file = sqlite_file(catalog)
        reserve = catalog_file and DiskReserve(catalog_file.parent, settings.min_free_bytes)
        self._journal = PeriodicTask("write journal", 2.0, JournalTask(catalog, store, metrics))
        self.tasks = [
            *([PeriodicTask("keep disk reserve", 5.0, reserve.maintain)] if reserve else []),
            PeriodicTask(
                "reclaim leases",
                1.0,
                lambda: metrics.leases_expired.inc(reclaim_leases(catalog)),
            ),
            PeriodicTask(
                "resend wakeups",
                2.0,
                lambda: metrics.wakeups_resent.inc(resend_wakeups(catalog, wakeups)),
            ),
            PeriodicTask(
                "advance model changes",
                0.5,
                lambda: advance_model_changes(catalog, wakeups, queued_chunks),
            ),
            PeriodicTask(
                "cancel jobs of ended model changes",
                0.5,
                lambda: cancel_jobs_of_abandoned_generations(catalog),
            ),
            PeriodicTask(
                "cancel photos of ended batches",
                1.0,
                lambda: cancel_items_of_ended_batches(catalog),
            ),
            PeriodicTask("repair generations", 5.0, lambda: repair_generations(catalog, store)),
            PeriodicTask("resume batches", 5.0, lambda: resume_batches(catalog, settings)),
            PeriodicTask(
                "remove dead search workers", 2.0, lambda: remove_dead_search_workers(catalog)
            ),
            PeriodicTask("fit vocabularies", 2.0, lambda: fit_due_vocabularies(catalog, wakeups)),
            PeriodicTask(
                "count large maps",
                10.0,
                lambda: update_statistics_of_large_maps(catalog),
                own_thread=True,
            ),
            PeriodicTask(
                "compact",
                5.0,
                lambda: metrics.slots_merged.inc(
                    merge_small_chunks(catalog, store, retries=merge_retries)
                ),
                own_thread=True,
            ),
            self._journal,
            PeriodicTask(
                "delete maps",
                1.0,
                lambda: purge_deleted_maps(catalog, counted("delete_maps")),
                own_thread=True,
            ),
            PeriodicTask(
                "collect",
                10.0,
                lambda: collect_garbage(catalog, counted("collect"), settings),
                own_thread=True,
            ),
            PeriodicTask(
                "forget old jobs",
                10.0,
                lambda: delete_old_jobs(catalog),
            ),
            PeriodicTask(
                "forget old searches",
                10.0,
                lambda: delete_old_searches(catalog, settings.search_history_days),
            ),
            PeriodicTask(
                "delete old tracks",
                10.0,
                lambda: delete_old_tracks(catalog, settings.track_retention_days),
            ),
            PeriodicTask(
                "forget old deliveries",
                10.0,
                lambda: delete_old_deliveries(catalog),
            ),
            PeriodicTask("forget old keys", 10.0, lambda: delete_expired_idempotency_keys(catalog)),
            PeriodicTask(
                "evaluate changed maps",
                2.0,
                lambda: evaluate_changed_maps(catalog, settings.auto_evaluate_photos),
            ),
            PeriodicTask(
                "collect orphans",
                3600.0,
                lambda: _collect_orphans(catalog, store, settings, metrics),
                own_thread=True,
            ),
            PeriodicTask(
                "free trash",
                10.0,
                lambda: metrics.objects_deleted.labels("free_trash").inc(
                    store.free_trash(FREE_TRASH_FACTOR * settings.min_free_bytes)
                ),
                uses_catalog=False,
            ),
        ]

    def run(self, stop: threading.Event) -> None:
        """Run due tasks until `stop` is set; then write the pending rows to the journal."""
        threads = [
            threading.Thread(target=self._run_alone, args=(task, stop), name=task.name)
            for task in self.tasks
            if task.own_thread
        ]
        for thread in threads:
            thread.start()
        shared = [task for task in self.tasks if not task.own_thread]
        while not stop.is_set():
            commits = self._catalog.commits.count
            for task in shared:
                if time.monotonic() >= task.next_run and not stop.is_set():
                    waits_for_time = self._run_task(task)
                    self._heartbeat.beat()
                    task.commits_seen = -1 if waits_for_time else commits
            stop.wait(SCHEDULER_TICK_SECONDS)
            if self._catalog.is_sqlite and all(task.commits_seen == commits for task in shared):
                self._catalog.wait_for_commit(stop, commits, IDLE_SECONDS)
        self._run_task(self._journal)
        for thread in threads:
            thread.join()

    def _run_alone(self, task: PeriodicTask, stop: threading.Event) -> None:
        poll = ChangePoll(self._catalog)
        while not stop.is_set():
            self._run_task(task)
            poll.wait(stop, task.interval_seconds)

    def _run_task(self, task: PeriodicTask) -> bool:
        """Run the task; return whether it returned True."""
        started, outcome, result = time.monotonic(), "done", None
        try:
            result = task.run()
            if task.uses_catalog:
                self._outage.record_success()
        except SQLAlchemyError as error:
            outcome = "catalog_unavailable"
            self._outage.record_error(error)
        except Exception:  # a failed task must not stop the others
            outcome = "failed"
            log.exception(
                "the periodic task %r failed; next run in %g s",
                task.name,
                task.interval_seconds,
            )
        self._metrics.observe_task(task.name, outcome, time.monotonic() - started)
        task.next_run = time.monotonic() + task.interval_seconds
        return result is True


def _collect_orphans(
    catalog: Catalog, store: OwnedStore, settings: Settings, metrics: StewardMetrics
) -> None:
    """Move orphans to the trash and delete expired trash, unless collection is held."""
    try:
        moved = collect_orphans(catalog, store, settings.orphan_age_seconds)
    except CollectionHeld as error:
        metrics.collection_held.set(1)
        log.error("orphan collection is held: %s", error.detail)
        return
    metrics.collection_held.set(0)
    metrics.objects_trashed.inc(moved)
    deleted, remaining = empty_expired_trash(catalog, store, settings.trash_days)
    metrics.objects_deleted.labels("collect_orphans").inc(deleted)
    metrics.trash_bytes.set(remaining.size_bytes)
