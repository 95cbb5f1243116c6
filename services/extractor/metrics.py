"""Prometheus metrics of an extractor; its child processes only decode and have none."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from services.extractor.handlers import JobBatch
from shared.descriptors.inference import gpu_memory
from shared.jobs import JobKind
from shared.jobs.runner import StepOutcome

METRIC_PREFIX = "placewise_extractor"
BATCH_SIZE_BUCKETS = (1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024)
# From projecting a small batch on a GPU to describing one with a ViT-g on a CPU.
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
    """Prometheus metrics of one worker."""

    def __init__(self, registry: CollectorRegistry) -> None:
        counter = partial(Counter, namespace=METRIC_PREFIX, registry=registry)
        gauge = partial(Gauge, namespace=METRIC_PREFIX, registry=registry)
        histogram = partial(Histogram, namespace=METRIC_PREFIX, registry=registry)
        self.batch_jobs = histogram(
            "batch_jobs", "Jobs per claimed batch.", ["kind"], buckets=BATCH_SIZE_BUCKETS
        )
        self._jobs = counter(
            "jobs",
            "Claimed jobs by outcome. lost: the lease was taken over, or the job was cancelled; "
            "paused, requeued: back in the queue; refused: failed, or back in the queue "
            "until an operator acts; crashed: back in the queue, alone.",
            ["kind", "outcome"],
        )
        self._failures = counter(
            "failures", "Failed jobs by the code of the error.", ["kind", "reason"]
        )
        self._stage_seconds = histogram(
            "stage_seconds",
            "Duration of a batch's stages in seconds.",
            ["stage"],
            buckets=STAGE_BUCKETS_SECONDS,
        )
        self.model_load_seconds = histogram(
            "model_load_seconds",
            "Duration of loading an extractor in seconds.",
            buckets=LOAD_BUCKETS_SECONDS,
        )
        self.draining = gauge("draining", "1 while the worker processes jobs.")
        registry.register(_DeviceMemoryCollector())

    def count_step_outcome(self, kind: JobKind, outcome: StepOutcome, jobs: int) -> None:
        """Count the jobs of a step that was not done; `observe_batch` counts the others."""
        if outcome != StepOutcome.DONE:
            label = "refused" if outcome == StepOutcome.FAILED else outcome
            self._jobs.labels(kind, label).inc(jobs)

    def observe_batch(self, batch: JobBatch) -> None:
        """Record the outcomes of a batch and the seconds of its steps."""
        for outcome, jobs in (+batch.outcomes).items():
            self._jobs.labels(batch.kind, outcome).inc(jobs)
        for reason, jobs in (+batch.reasons).items():
            self._failures.labels(batch.kind, reason).inc(jobs)
        for step, seconds in batch.seconds.items():
            self._stage_seconds.labels(step).observe(seconds)


class _DeviceMemoryCollector(Collector):
    """GPU memory, read at each scrape."""

    def collect(self) -> Iterable[Metric]:
        used = GaugeMetricFamily(
            f"{METRIC_PREFIX}_device_used_bytes",
            "GPU memory allocated by PyTorch in this process.",
            labels=["device"],
        )
        total = GaugeMetricFamily(
            f"{METRIC_PREFIX}_device_total_bytes", "Total memory of the GPU.", labels=["device"]
        )
        for device in gpu_memory():
            used.add_metric([device.name], device.used_bytes)
            total.add_metric([device.name], device.total_bytes)
        yield used
        yield total
