"""Prometheus metrics of a search worker, served at `/metrics`."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from uuid import UUID

from prometheus_client import CollectorRegistry, Counter, Histogram, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from services.search.worker import SearchWorker
from shared.errors import PlacewiseError
from shared.search_api.protocol import (
    MatchRequest,
    MatchResponse,
    PoseRequest,
    PoseResponse,
    SearchRequest,
    SearchResponse,
    SearchStatus,
)

METRIC_PREFIX = "placewise_search"
# Seconds, from a small map in memory to a dense scan of a full worker, and the longest wait for a
# version.
LATENCY_BUCKETS = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0)

# The maximum over some dozens of rows. From 5.5 on sign codes are not trusted (`executor.py`).
MAX_Z_BUCKETS = (1.0, 2.0, 3.0, 4.0, 5.0, 5.5)


class MeteredSearch:
    """`SearchBackend` that counts the searches of a worker.

    The metrics are registered in `registry`, or else in a registry of their own, as tests run
    several workers in one process.
    """

    def __init__(self, worker: SearchWorker, registry: CollectorRegistry | None = None) -> None:
        self._worker = worker
        self._registry = registry or CollectorRegistry()
        counter = partial(Counter, namespace=METRIC_PREFIX, registry=self._registry)
        histogram = partial(Histogram, namespace=METRIC_PREFIX, registry=self._registry)
        self._requests = {
            name: (
                counter(name, f"{what} by outcome: answered, or the error code.", ["outcome"]),
                histogram(
                    seconds,
                    f"Duration of successful {what.lower()} in seconds.",
                    buckets=LATENCY_BUCKETS,
                ),
            )
            for name, seconds, what in (
                ("searches", "seconds", "Searches"),
                ("matches", "match_seconds", "Match requests"),
                ("poses", "pose_seconds", "Pose requests"),
            )
        }
        self._rows = counter("rows_scanned", "Descriptor rows compared with a query.")
        self._reranked = counter(
            "rows_reranked", "Descriptor rows compared exactly, by their full descriptors."
        )
        self._certificates = counter("answers", "Responses by certificate.", ["certificate"])
        self._deviations = histogram(
            "max_z",
            "Largest error of a response's sign-code estimates, in standard deviations.",
            buckets=MAX_Z_BUCKETS,
        )
        self._matched_photos = counter(
            "matched_photos", "Photos by outcome: matched or without_features.", ["outcome"]
        )
        self._pose_answers = counter(
            "pose_answers", "Answered pose requests by outcome: found or no_pose.", ["outcome"]
        )
        self._registry.register(_SnapshotCollector(worker))

    def search(self, request: SearchRequest) -> SearchResponse:
        """Search and record the metrics of the response."""
        with self._measured("searches"):
            response = self._worker.search(request)
        self._rows.inc(response.rows_scanned)
        self._reranked.inc(response.rows_reranked)
        self._certificates.labels(response.certificate).inc()
        if response.max_z is not None:
            self._deviations.observe(response.max_z)
        return response

    def match(self, request: MatchRequest) -> MatchResponse:
        """Match and record the metrics of the response."""
        with self._measured("matches"):
            response = self._worker.match(request)
        matched = sum(each is not None for each in response.candidates)
        self._matched_photos.labels("matched").inc(matched)
        self._matched_photos.labels("without_features").inc(len(request.candidates) - matched)
        return response

    def estimate_pose(self, request: PoseRequest) -> PoseResponse:
        """Compute a pose and record whether there is one."""
        with self._measured("poses"):
            response = self._worker.estimate_pose(request)
        self._pose_answers.labels("no_pose" if response.pose is None else "found").inc()
        return response

    def status(self) -> SearchStatus:
        return self._worker.status()

    def render(self) -> bytes:
        """Render the metrics in Prometheus' text format."""
        return generate_latest(self._registry)

    @contextlib.contextmanager
    def _measured(self, kind: str) -> Iterator[None]:
        """Count the request of the block by its outcome, and observe its duration on success."""
        requests, seconds = self._requests[kind]
        started = time.perf_counter()
        try:
            yield
        except PlacewiseError as error:
            requests.labels(error.code).inc()
            raise
        requests.labels("answered").inc()
        seconds.observe(time.perf_counter() - started)


class _SnapshotCollector(Collector):
    """Metrics computed at each scrape, so that a deleted generation leaves no stale series."""

    def __init__(self, worker: SearchWorker) -> None:
        self._worker = worker

    def collect(self) -> Iterable[Metric]:
        status, batcher = self._worker.status(), self._worker.query_batcher
        for name, text, value in (
            ("resident_bytes", "Bytes of descriptors in memory.", status.resident_bytes),
            ("mapped_bytes", "Bytes of descriptors on disk.", status.mapped_bytes),
            ("rows", "Searchable rows.", status.rows),
            ("missing_chunks", "Unreadable chunks.", len(status.missing)),
            ("unwritten_chunks", "Chunks still to be written to Milvus.", status.unwritten),
        ):
            yield GaugeMetricFamily(f"{METRIC_PREFIX}_{name}", text, value)
        scans = "First-level scans of the sign codes."
        yield CounterMetricFamily(f"{METRIC_PREFIX}_code_scans", scans, batcher.batches_run)
        queries = "Queries in first-level scans of the sign codes."
        yield CounterMetricFamily(
            f"{METRIC_PREFIX}_code_scan_queries", queries, batcher.queries_run
        )
        lags = status.lags.items()
        of_generations: tuple[tuple[str, str, Mapping[UUID, float]], ...] = (
            ("recall", "Measured recall of an approximate index.", status.recalls),
            ("version", "Version of the map in the snapshot.", status.versions),
            ("lag_versions", "Versions behind the map.", {k: lag.versions for k, lag in lags}),
            (
                "lag_seconds",
                "Seconds since the snapshot was last known to be current.",
                {k: lag.seconds for k, lag in lags},
            ),
        )
        for name, text, values in of_generations:
            family = GaugeMetricFamily(
                f"{METRIC_PREFIX}_snapshot_{name}", text, labels=["generation"]
            )
            for key, amount in values.items():
                family.add_metric([str(key)], float(amount))
            yield family
