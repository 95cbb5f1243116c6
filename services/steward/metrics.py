"""What Prometheus reads of a steward: its rounds, what it mended, what it threw away."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

METRIC_PREFIX = "placewise_steward"
# From a look that finds nothing to a walk over a whole bucket.
TASK_BUCKETS_SECONDS = (0.005, 0.01, 0.05, 0.1, 0.5, 1.0, 5.0, 10.0, 60.0, 300.0, 900.0)


class StewardMetrics:
    """One steward's figures; several stewards' add up."""

    def __init__(self, registry: CollectorRegistry) -> None:
        self._duties = Counter(
            f"{METRIC_PREFIX}_duties",
            "Rounds of each duty by what became of them: done, failed, or catalog_away.",
            ["duty", "outcome"],
            registry=registry,
        )
        self._duty_seconds = Histogram(
            f"{METRIC_PREFIX}_duty_seconds",
            "Seconds that a round of a duty took.",
            ["duty"],
            buckets=TASK_BUCKETS_SECONDS,
            registry=registry,
        )
        self.leases_expired = Counter(
            f"{METRIC_PREFIX}_leases_expired",
            "Jobs that were taken back from workers that fell silent.",
            registry=registry,
        )
        self.hints_resent = Counter(
            f"{METRIC_PREFIX}_hints_resent",
            "Hints for work that was found waiting.",
            registry=registry,
        )
        self.slots_merged = Counter(
            f"{METRIC_PREFIX}_slots_merged", "Slots whose chunks became one.", registry=registry
        )
        self.journal_lines = Counter(
            f"{METRIC_PREFIX}_journal_lines",
            "Rows of the catalog that were written to the journal.",
            registry=registry,
        )
        self.catalog_lag_segments = Gauge(
            f"{METRIC_PREFIX}_catalog_lag_segments",
            "Journal segments of the object store that the catalog does not know: 0, unless an "
            "older catalog was restored.",
            registry=registry,
        )
        self.objects_deleted = Counter(
            f"{METRIC_PREFIX}_objects_deleted",
            "Objects that nothing refers to any more.",
            ["duty"],
            registry=registry,
        )
        self.objects_trashed = Counter(
            f"{METRIC_PREFIX}_objects_trashed",
            "Orphaned objects that were moved to the trash.",
            registry=registry,
        )
        self.collection_held = Gauge(
            f"{METRIC_PREFIX}_collection_held",
            "1 while orphans are not collected before `placewise storage collect --confirm`.",
            registry=registry,
        )
        self.trash_bytes = Gauge(
            f"{METRIC_PREFIX}_trash_bytes",
            "Bytes in the trash after the last collection.",
            registry=registry,
        )
        self._jobs = Counter(
            f"{METRIC_PREFIX}_jobs",
            "The steward's own jobs, slice by slice, by what became of each: done, stopped, "
            "paused, failed, crashed.",
            ["kind", "outcome"],
            registry=registry,
        )
        self._last_success: dict[str, float] = {}
        registry.register(_TaskLagCollector(self._last_success))

    def observe_task(self, name: str, outcome: str, seconds: float) -> None:
        """A round of the duty has ended."""
        duty = name.replace(" ", "_")
        self._duties.labels(duty, outcome).inc()
        self._duty_seconds.labels(duty).observe(seconds)
        if outcome == "done":
            self._last_success[duty] = time.monotonic()

    def count_job(self, kind: str, outcome: str) -> None:
        """A slice of one of its jobs has ended."""
        self._jobs.labels(kind, outcome).inc()


class _TaskLagCollector(Collector):
    def __init__(self, done_at: Mapping[str, float]) -> None:
        self._done_at = done_at

    def collect(self) -> Iterable[Metric]:
        lag = GaugeMetricFamily(
            f"{METRIC_PREFIX}_duty_lag_seconds",
            "Seconds since a round of the duty was last done.",
            labels=["duty"],
        )
        now = time.monotonic()
        for duty, done_at in dict(self._done_at).items():
            lag.add_metric([duty], now - done_at)
        yield lag
