"""What Prometheus reads of an extractor. One process, one registry: children only decode."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterable, Iterator

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from services.extractor.publish import Published
from shared.jobs import JobKind
from shared.vision.device_memory import device_memory

PREFIX = "placewise_extractor"
BATCH_JOBS = (1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024)
# From a small map's rows on a GPU to a ViT-g's batch on a CPU.
SECONDS = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0, 120.0)
LOAD_SECONDS = (0.1, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0, 300.0)


class ExtractorMetrics:
    """One worker's figures."""

    def __init__(self, registry: CollectorRegistry) -> None:
        self._batch_jobs = Histogram(
            f"{PREFIX}_batch_jobs",
            "Jobs in a claimed batch; its count is that of the claims.",
            ["kind"],
            buckets=BATCH_JOBS,
            registry=registry,
        )
        self._jobs = Counter(
            f"{PREFIX}_jobs",
            "Claimed jobs by what became of them. lost: the lease was taken over, or the job was "
            "cancelled; paused, waiting, given_back: queued again; refused: failed, or paused "
            "until an operator acts; crashed: tried again alone.",
            ["kind", "outcome"],
            registry=registry,
        )
        self._stage_seconds = Histogram(
            f"{PREFIX}_stage_seconds",
            "Seconds of a batch in each of its stages.",
            ["stage"],
            buckets=SECONDS,
            registry=registry,
        )
        self._load_seconds = Histogram(
            f"{PREFIX}_model_load_seconds",
            "Seconds that loading an extractor took; its count is that of the loads.",
            buckets=LOAD_SECONDS,
            registry=registry,
        )
        self._drain_seconds = Histogram(
            f"{PREFIX}_drain_seconds",
            "Seconds of drains that claimed something.",
            buckets=SECONDS,
            registry=registry,
        )
        self._draining = Gauge(
            f"{PREFIX}_draining", "1 while the worker is at work.", registry=registry
        )
        registry.register(_DeviceMemory())

    def claimed(self, kind: JobKind, jobs: int) -> None:
        self._batch_jobs.labels(kind).observe(jobs)

    def ended(self, kind: JobKind, outcome: str, jobs: int = 1) -> None:
        self._jobs.labels(kind, outcome).inc(jobs)

    def published(self, kind: JobKind, outcome: Published, seconds: dict[str, float]) -> None:
        """A batch has come to its end; `seconds` are those of its stages."""
        for name, jobs in (
            ("succeeded", outcome.succeeded),
            ("failed", outcome.failed),
            ("lost", outcome.lost),
        ):
            if jobs:
                self.ended(kind, name, jobs)
        for stage, took in seconds.items():
            self.stage(stage, took)

    def stage(self, name: str, seconds: float) -> None:
        self._stage_seconds.labels(name.replace(" ", "_")).observe(seconds)

    def loaded(self, seconds: float) -> None:
        self._load_seconds.observe(seconds)

    @contextlib.contextmanager
    def draining(self) -> Iterator[None]:
        started = time.perf_counter()
        self._draining.set(1)
        try:
            yield
        finally:
            self._draining.set(0)
            self._drain_seconds.observe(time.perf_counter() - started)


class _DeviceMemory(Collector):
    def collect(self) -> Iterable[Metric]:
        used = GaugeMetricFamily(
            f"{PREFIX}_device_used_bytes", "GPU memory that PyTorch holds here.", labels=["device"]
        )
        total = GaugeMetricFamily(
            f"{PREFIX}_device_total_bytes", "Memory of the GPU.", labels=["device"]
        )
        for device in device_memory():
            used.add_metric([device.name], device.used_bytes)
            total.add_metric([device.name], device.total_bytes)
        yield used
        yield total
