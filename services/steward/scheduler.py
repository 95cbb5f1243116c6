"""The steward's scheduler: runs each periodic maintenance task at its interval.

Short tasks share one thread. A task that reads a whole map or the whole store has its own.
"""

from __future__ import annotations

import logging
import threading
import time

from prometheus_client import CollectorRegistry
from sqlalchemy.exc import SQLAlchemyError

import services.steward.batches.worker
import services.steward.library_sync
import services.steward.tasks.auto_evaluation
import services.steward.tasks.auto_fit
import services.steward.tasks.compaction
import services.steward.tasks.delete_maps
import services.steward.tasks.garbage_collection
import services.steward.tasks.maintenance
import services.steward.tasks.model_changes
import services.steward.tasks.reindex_jobs  # noqa: F401  (they register their tasks)
from services.steward.metrics import StewardMetrics
from services.steward.periodic_tasks import PeriodicTask, registered_tasks
from services.steward.tasks.orphans import CollectionHeld, collect_orphans, empty_expired_trash
from shared.catalog.database.errors import OutageLog
from shared.catalog.database.session import IDLE_SECONDS, Catalog, ChangePoll
from shared.config.settings import Settings
from shared.jobs import Wakeups
from shared.journal.outbox import write_journal, write_snapshot
from shared.storage import OwnedStore
from shared.storage.read_retries import ReadRetries
from shared.telemetry.heartbeat import Heartbeat

log = logging.getLogger(__name__)


SCHEDULER_TICK_SECONDS = 0.25
# Objects in the trash are deleted before the gateway rejects uploads (MIN_FREE_BYTES).
FREE_TRASH_FACTOR = 2


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

        resources = {
            "catalog": catalog,
            "store": store,
            "wakeups": wakeups,
            "settings": settings,
            "retries": ReadRetries(),
            "queued_chunks": {},
        }
        self._journal = PeriodicTask(
            "write_journal",
            2.0,
            lambda: write_journal(catalog, store),
            counter="journal_lines",
        )
        self.tasks = [
            *registered_tasks(resources),
            self._journal,
            PeriodicTask(
                "write_snapshot", 60.0, lambda: write_snapshot(catalog, store), own_thread=True
            ),
            PeriodicTask(
                "collect_orphans",
                3600.0,
                lambda: _collect_orphans(catalog, store, settings, metrics),
                own_thread=True,
            ),
            PeriodicTask(
                "free_trash",
                10.0,
                lambda: store.free_trash(FREE_TRASH_FACTOR * settings.min_free_bytes),
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
            if task.counter is not None:
                getattr(self._metrics, task.counter).inc(result)
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
    metrics.trash_bytes.set(empty_expired_trash(catalog, store, settings.trash_days))
