"""Prometheus metrics of the gateway: requests, uploads, connections and the job queue.

`GET /metrics` serves them. The number of jobs by kind and state, and the age of the oldest, are
read from the catalog and are therefore the same on every gateway.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Sequence
from functools import partial

from fastapi import APIRouter, Request, Response
from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector
from sqlalchemy import and_, case, func, literal_column, select
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from services.gateway.admission import AdmissionControl, UploadKind
from services.gateway.dependencies import GatewayContext
from services.request_log import RequestRecord
from shared.catalog.database.base import db_now
from shared.catalog.jobs import Job, JobState
from shared.catalog.maps import Map
from shared.jobs.queue_depth import PolledValue
from shared.telemetry.metrics_server import METRICS_CONTENT_TYPE

QUEUE_POLL_SECONDS = 5.0
COUNTED_STATES = (JobState.QUEUED, JobState.RUNNING, JobState.FAILED)


def count_jobs(session: Session) -> Sequence[tuple[str, str, int, float]]:
    """Count the jobs of all maps by kind and state.

    Succeeded jobs, by far the most, are excluded, so that the index on (map, state) is used.

    Returns:
        Kind, state, number of jobs and age of the oldest in seconds. The state `waiting` is added
        for queued jobs that no worker may claim yet.
    """
    state = case((Job.waiting_for.is_not(None), literal_column("'waiting'")), else_=Job.state)
    rows = session.execute(
        select(Job.kind, state, func.count(), func.min(Job.created_at), db_now())
        .join_from(Map, Job, and_(Job.map_id == Map.id, Job.state.in_(COUNTED_STATES)))
        .group_by(Job.kind, state)
        .order_by(Job.kind, state)
    )
    return [
        (kind, counted_state, count, max(0.0, (now - oldest).total_seconds()))
        for kind, counted_state, count, oldest, now in rows
    ]


router = APIRouter(tags=["operations"])

# Seconds, from a health probe to the longest `Prefer: wait`.
LATENCY_BUCKETS = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0)
METRIC_PREFIX = "placewise_gateway"


class GatewayMetrics:
    """Metrics of one gateway. Labels are route templates, not paths, to bound their cardinality."""

    def __init__(self, gateway: GatewayContext, admission: AdmissionControl) -> None:
        registry = gateway.registry
        counter = partial(Counter, namespace=METRIC_PREFIX, registry=registry)
        self._requests = counter(
            "requests", "Requests by route and response status.", ["method", "route", "status"]
        )
        self._seconds = Histogram(
            "request_seconds",
            "Seconds from the request to the first byte of the response.",
            ["method", "route"],
            namespace=METRIC_PREFIX,
            buckets=LATENCY_BUCKETS,
            registry=registry,
        )
        self._received = counter(
            "received_bytes", "Bytes of request bodies, mainly uploads and query photos.", ["route"]
        )
        self._in_flight = Gauge(
            "requests_under_way",
            "Requests in flight.",
            namespace=METRIC_PREFIX,
            registry=registry,
        )
        registry.register(_LoadCollector(gateway, admission))

    def on_request_start(self) -> None:
        """Count a request in flight."""
        self._in_flight.inc()

    def on_request_end(self, record: RequestRecord) -> None:
        """Record a finished request."""
        self._in_flight.dec()
        self._requests.labels(record.method, record.route, str(record.status)).inc()
        if record.first_byte_seconds is not None:
            self._seconds.labels(record.method, record.route).observe(record.first_byte_seconds)
        if record.received_bytes:
            self._received.labels(record.route).inc(record.received_bytes)


class _LoadCollector(Collector):
    """Collects the job queue, uploads, connections and the free disk space at each scrape."""

    def __init__(self, gateway: GatewayContext, admission: AdmissionControl) -> None:
        self._catalog = gateway.catalog
        self._connections = gateway.connections
        self._admission = admission
        self._wakeups = gateway.wakeups
        self._job_counts = PolledValue(self._count_jobs, QUEUE_POLL_SECONDS)

    def _count_jobs(self) -> Sequence[tuple[str, str, int, float]] | None:
        """Count the jobs; None while the catalog is unreachable."""
        try:
            with self._catalog.read() as session:
                return count_jobs(session)
        except SQLAlchemyError:
            return None

    def describe(self) -> Iterable[Metric]:
        return []  # otherwise registering would call `collect` and query the catalog

    def collect(self) -> Iterable[Metric]:
        receiving = _gauge("receiving", "Files being received.", ["kind"])
        for kind in UploadKind:
            receiving.add_metric([kind.name.lower()], self._admission.active_uploads(kind))
        yield receiving
        yield _gauge("connections", "Open connections.", value=self._connections.count)
        closed = CounterMetricFamily(
            f"{METRIC_PREFIX}_connections_closed",
            "Connections refused or closed because of a limit.",
            labels=["reason"],
        )
        for reason, count in self._connections.closed.items():
            closed.add_metric([reason], count)
        yield closed
        if (free_bytes := self._admission.disk.free_bytes()) is not None:
            yield _gauge(
                "disk_free_bytes",
                "Free bytes of the local disks that Placewise writes to.",
                value=free_bytes,
            )
        redis_up = float(self._wakeups.problem is None)
        yield _gauge("redis_up", "1 if Redis takes messages, or none is used.", value=redis_up)
        queue = self._job_counts.get()
        yield _gauge("catalog_up", "1 if the catalog is reachable.", value=float(queue is not None))
        if queue is None:
            return
        jobs = _gauge(
            "jobs",
            "Unfinished and failed jobs. State `waiting`: for a vocabulary, descriptors, search or "
            "disk space.",
            ["kind", "state"],
        )
        oldest = _gauge(
            "oldest_job_seconds",
            "Age of the oldest job of this kind and state, in seconds.",
            ["kind", "state"],
        )
        for job_kind, state, count, oldest_seconds in queue:
            jobs.add_metric([job_kind, state], count)
            oldest.add_metric([job_kind, state], oldest_seconds)
        yield jobs
        yield oldest
        with contextlib.suppress(SQLAlchemyError):
            yield _gauge(
                "extractors_stalled",
                "1 if a job waits much longer than usual while none is finished.",
                value=float(self._admission.queue_depth().is_stalled),
            )


def _gauge(
    name: str,
    documentation: str,
    labels: Sequence[str] | None = None,
    value: float | None = None,
) -> GaugeMetricFamily:
    return GaugeMetricFamily(f"{METRIC_PREFIX}_{name}", documentation, value, labels)


@router.get("/metrics", operation_id="metrics", response_class=Response)
def read_metrics(request: Request) -> Response:
    """Metrics in the Prometheus text format. METRICS_PORT serves the same without a key."""
    registry: CollectorRegistry = request.app.state.gateway.registry
    return Response(generate_latest(registry), media_type=METRICS_CONTENT_TYPE)
