"""Prometheus metrics of a steward: runs of periodic tasks, repairs, deletions and jobs.

A periodic task is called `duty` in metric names and labels.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from functools import partial

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

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
            "duties",
            "Runs of each periodic task by outcome: done, failed, or catalog_away.",
            ["duty", "outcome"],
        )
        self._task_seconds = histogram(
            "duty_seconds",
            "Duration of a run of a periodic task, in seconds.",
            ["duty"],
            buckets=TASK_BUCKETS_SECONDS,
        )
        self.leases_expired = counter(
            "leases_expired", "Jobs whose lease expired because their worker died."
        )
        self.hints_resent = counter("hints_resent", "Wakeups sent again for waiting jobs.")
        self.slots_merged = counter("slots_merged", "Slots whose chunks were merged into one.")
        self.journal_lines = counter("journal_lines", "Catalog rows written to the journal.")
        self.catalog_lag_segments = gauge(
            "catalog_lag_segments",
            "Journal segments in the object store that the catalog does not know: 0, unless an "
            "older catalog was restored.",
        )
        self.objects_deleted = counter(
            "objects_deleted", "Deleted objects that nothing referred to any more.", ["duty"]
        )
        self.objects_trashed = counter("objects_trashed", "Orphaned objects moved to the trash.")
        self.collection_held = gauge(
            "collection_held",
            "1 while orphan collection waits for `placewise storage collect --confirm`, else 0.",
        )
        self.trash_bytes = gauge("trash_bytes", "Bytes in the trash after the last collection.")
        self._jobs = counter(
            "jobs",
            "Slices of the steward's own jobs by outcome: done, stopped, paused, failed, crashed.",
            ["kind", "outcome"],
        )
        self._last_success: dict[str, float] = {}
        registry.register(_TaskLagCollector(self._last_success))

    def observe_task(self, name: str, outcome: str, seconds: float) -> None:
        """Record a run of a periodic task."""
        duty = name.replace(" ", "_")
        self._task_runs.labels(duty, outcome).inc()
        self._task_seconds.labels(duty).observe(seconds)
        if outcome == "done":
            self._last_success[duty] = time.monotonic()

    def count_jobs(self, kind: JobKind, outcome: StepOutcome, jobs: int) -> None:
        """Record a slice of the steward's own jobs."""
        self._jobs.labels(kind, outcome).inc(jobs)


class _TaskLagCollector(Collector):
    def __init__(self, last_success: Mapping[str, float]) -> None:
        self._last_success = last_success

    def collect(self) -> Iterable[Metric]:
        lag = GaugeMetricFamily(
            f"{METRIC_PREFIX}_duty_lag_seconds",
            "Seconds since the last successful run of the periodic task.",
            labels=["duty"],
        )
        now = time.monotonic()
        for duty, succeeded_at in dict(self._last_success).items():
            lag.add_metric([duty], now - succeeded_at)
        yield lag
