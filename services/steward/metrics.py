"""Prometheus metrics of a steward: runs of periodic tasks, repairs and jobs."""

from __future__ import annotations

import time
from functools import partial

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram

from shared.jobs import JobKind
from shared.jobs.runner import StepOutcome

METRIC_PREFIX = "placewise_steward"
# From one query that finds nothing to a walk over a whole bucket.
TASK_BUCKETS_SECONDS = (0.005, 0.01, 0.05, 0.1, 0.5, 1.0, 5.0, 10.0, 60.0, 300.0, 900.0)


class StewardMetrics:
    """The metrics of one steward process; those of several stewards can be summed."""

    def __init__(self, registry: CollectorRegistry) -> None:
        counter = partial(Counter, namespace=METRIC_PREFIX, registry=registry)
        gauge = partial(Gauge, namespace=METRIC_PREFIX, registry=registry)
        histogram = partial(Histogram, namespace=METRIC_PREFIX, registry=registry)
        self._task_runs = counter(
            "tasks",
            "Runs of each periodic task by outcome: done, failed, or catalog_unavailable.",
            ["task", "outcome"],
        )
        self._task_seconds = histogram(
            "task_seconds",
            "Duration of a run of a periodic task, in seconds.",
            ["task"],
            buckets=TASK_BUCKETS_SECONDS,
        )
        self.leases_expired = counter(
            "leases_expired", "Jobs whose lease expired because their worker died."
        )
        self.wakeups_resent = counter("wakeups_resent", "Wakeups sent again for waiting jobs.")
        self.compactions = counter("compactions", "Chunks that were merged into one, or rewritten.")
        self.journal_lines = counter("journal_lines", "Catalog rows written to the journal.")
        self.objects_trashed = counter("objects_trashed", "Orphaned objects moved to the trash.")
        self.collection_held = gauge(
            "collection_held",
            "1 while orphan collection waits for `placewise storage collect --confirm`, else 0.",
        )
        self.trash_bytes = gauge("trash_bytes", "Bytes in the trash after the last collection.")
        self._jobs = counter(
            "jobs",
            "Slices of the steward's own jobs by outcome: done, requeued, paused, failed, crashed.",
            ["kind", "outcome"],
        )
        self._task_lag = gauge(
            "task_lag_seconds",
            "Seconds since the last successful run of the periodic task.",
            ["task"],
        )

    def observe_task(self, name: str, outcome: str, seconds: float) -> None:
        """Record a run of a periodic task."""
        task = name.replace(" ", "_")
        self._task_runs.labels(task, outcome).inc()
        self._task_seconds.labels(task).observe(seconds)
        if outcome == "done":
            succeeded_at = time.monotonic()
            self._task_lag.labels(task).set_function(lambda: time.monotonic() - succeeded_at)

    def count_jobs(self, kind: JobKind, outcome: StepOutcome, jobs: int) -> None:
        """Record a slice of the steward's own jobs."""
        self._jobs.labels(kind, outcome).inc(jobs)
