"""What Prometheus reads of an extractor. One process, one registry: children only decode.

What one drain of the extractor's worker did.
"""

from __future__ import annotations

import contextlib
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from services.extractor.publish import PublishResult
from shared.descriptors.inference import gpu_memory
from shared.jobs import JobKind

METRIC_PREFIX = "placewise_extractor"
BATCH_SIZE_BUCKETS = (1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024)
# From a small map's rows on a GPU to a ViT-g's batch on a CPU.
STAGE_BUCKETS_SECONDS = (
    0.005,
    0.01,
    0.025,
    0.05,
    0.1,
    0.25,
    0.5,
    1.0,
    2.5,
    5.0,
    10.0,
    30.0,
    60.0,
    120.0,
)
LOAD_BUCKETS_SECONDS = (0.1, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0, 300.0)


class ExtractorMetrics:
    """One worker's figures."""

    def __init__(self, registry: CollectorRegistry) -> None:
        self._batch_jobs = Histogram(
            f"{METRIC_PREFIX}_batch_jobs",
            "Jobs in a claimed batch; its count is that of the claims.",
            ["kind"],
            buckets=BATCH_SIZE_BUCKETS,
            registry=registry,
        )
        self._jobs = Counter(
            f"{METRIC_PREFIX}_jobs",
            "Claimed jobs by what became of them. lost: the lease was taken over, or the job was "
            "cancelled; paused, waiting, given_back: queued again; refused: failed, or paused "
            "until an operator acts; crashed: tried again alone.",
            ["kind", "outcome"],
            registry=registry,
        )
        self._stage_seconds = Histogram(
            f"{METRIC_PREFIX}_stage_seconds",
            "Seconds of a batch in each of its stages.",
            ["stage"],
            buckets=STAGE_BUCKETS_SECONDS,
            registry=registry,
        )
        self._load_seconds = Histogram(
            f"{METRIC_PREFIX}_model_load_seconds",
            "Seconds that loading an extractor took; its count is that of the loads.",
            buckets=LOAD_BUCKETS_SECONDS,
            registry=registry,
        )
        self._drain_seconds = Histogram(
            f"{METRIC_PREFIX}_drain_seconds",
            "Seconds of drains that claimed something.",
            buckets=STAGE_BUCKETS_SECONDS,
            registry=registry,
        )
        self._draining = Gauge(
            f"{METRIC_PREFIX}_draining", "1 while the worker is at work.", registry=registry
        )
        registry.register(_DeviceMemoryCollector())

    def observe_claim(self, kind: JobKind, jobs: int) -> None:
        self._batch_jobs.labels(kind).observe(jobs)

    def count_outcome(self, kind: JobKind, outcome: str, jobs: int = 1) -> None:
        self._jobs.labels(kind, outcome).inc(jobs)

    def observe_batch(
        self, kind: JobKind, outcome: PublishResult, seconds: dict[str, float]
    ) -> None:
        """A batch has come to its end; `seconds` are those of its stages."""
        for name, jobs in (
            ("succeeded", outcome.succeeded),
            ("failed", outcome.failed),
            ("lost", outcome.lost),
        ):
            if jobs:
                self.count_outcome(kind, name, jobs)
        for stage, took in seconds.items():
            self.observe_stage(stage, took)

    def observe_stage(self, name: str, seconds: float) -> None:
        self._stage_seconds.labels(name.replace(" ", "_")).observe(seconds)

    def observe_model_load(self, seconds: float) -> None:
        self._load_seconds.observe(seconds)

    @contextlib.contextmanager
    def measure_drain(self) -> Iterator[None]:
        started = time.perf_counter()
        self._draining.set(1)
        try:
            yield
        finally:
            self._draining.set(0)
            self._drain_seconds.observe(time.perf_counter() - started)


class _DeviceMemoryCollector(Collector):
    def collect(self) -> Iterable[Metric]:
        used = GaugeMetricFamily(
            f"{METRIC_PREFIX}_device_used_bytes",
            "GPU memory that PyTorch holds here.",
            labels=["device"],
        )
        total = GaugeMetricFamily(
            f"{METRIC_PREFIX}_device_total_bytes", "Memory of the GPU.", labels=["device"]
        )
        for device in gpu_memory():
            used.add_metric([device.name], device.used_bytes)
            total.add_metric([device.name], device.total_bytes)
        yield used
        yield total


@dataclass(slots=True)
class DrainStats:
    """What one drain did: this is what the operator sees."""

    maps: set[str] = field(default_factory=set)
    claimed: int = 0
    succeeded: int = 0
    failed: int = 0
    seconds: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))
    interrupted: bool = False
    """It ended before the work did."""

    def merge(self, other: DrainStats) -> None:
        """Count what another one has counted, too."""
        self.maps |= other.maps
        self.claimed += other.claimed
        self.succeeded += other.succeeded
        self.failed += other.failed
        for stage, took in other.seconds.items():
            self.seconds[stage] += took

    def add_batch(self, outcome: PublishResult, seconds: dict[str, float]) -> None:
        """Count what a batch came to, and the time of its stages."""
        self.succeeded += outcome.succeeded
        self.failed += outcome.failed
        for stage, took in seconds.items():
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
