"""What Prometheus reads of a gateway: its calls, what it receives, and the queue in the catalog.

How many jobs there are in which state, and how old the oldest is: for the figures.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

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
from services.http_connections import Connections
from services.request_log import RequestRecord
from shared.catalog.base import db_now
from shared.catalog.jobs import Job, JobState
from shared.catalog.maps import Map
from shared.catalog.session import Catalog
from shared.telemetry.metrics_server import METRICS_CONTENT_TYPE

QUEUE_POLL_SECONDS = 5.0
POLL_COST_DIVISOR = 20  # a look that takes long is taken seldom: one part in so many of the time
COUNTED_STATES = (JobState.QUEUED, JobState.RUNNING, JobState.FAILED)


@dataclass(frozen=True, slots=True)
class JobCount:
    """The jobs of one kind in one state; `waiting` are those that no worker may take yet."""

    kind: str
    state: str
    count: int
    oldest_seconds: float


class QueueMetrics:
    """A look that is shared by all who ask within LOOK_SECONDS. Thread-safe."""

    def __init__(self, catalog: Catalog) -> None:
        self._catalog = catalog
        self._lock = threading.Lock()
        self._cached: Sequence[JobCount] | None = None
        self._next_poll = 0.0

    def job_counts(self) -> Sequence[JobCount] | None:
        """None while the catalog is away."""
        with self._lock:
            began = time.monotonic()
            if began < self._next_poll:
                return self._cached
            try:
                with self._catalog.read() as session:
                    self._cached = count_jobs(session)
            except SQLAlchemyError:
                self._cached = None
            took = time.monotonic() - began
            self._next_poll = began + max(QUEUE_POLL_SECONDS, POLL_COST_DIVISOR * took)
            return self._cached


def count_jobs(session: Session) -> list[JobCount]:
    """Of all maps. The index of a map's jobs by state serves it: those that succeeded, by far the
    most, are not looked at."""
    state = case((Job.waiting_for.is_not(None), literal_column("'waiting'")), else_=Job.state)
    found = session.execute(
        select(Job.kind, state, func.count(), func.min(Job.created_at), db_now())
        .join_from(Map, Job, and_(Job.map_id == Map.id, Job.state.in_(COUNTED_STATES)))
        .group_by(Job.kind, state)
        .order_by(Job.kind, state)
    )
    return [
        JobCount(kind, now_state, count, max(0.0, (now - oldest).total_seconds()))
        for kind, now_state, count, oldest, now in found
    ]


router = APIRouter(tags=["operations"])

# From a probe to the longest `Prefer: wait`.
LATENCY_BUCKETS_SECONDS = (
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
)
METRIC_PREFIX = "placewise_gateway"


class GatewayMetrics:
    """One gateway's figures. Labels are route templates, never paths: there are few of them."""

    def __init__(self, gateway: GatewayContext, admission: AdmissionControl) -> None:
        registry = gateway.registry
        self._requests = Counter(
            f"{METRIC_PREFIX}_requests",
            "Calls by route and by the answer's status.",
            ["method", "route", "status"],
            registry=registry,
        )
        self._seconds = Histogram(
            f"{METRIC_PREFIX}_request_seconds",
            "Seconds from a call to the first byte of its answer.",
            ["method", "route"],
            buckets=LATENCY_BUCKETS_SECONDS,
            registry=registry,
        )
        self._received = Counter(
            f"{METRIC_PREFIX}_received_bytes",
            "Bytes of the bodies of calls: uploads and query photos, nearly all of them.",
            ["route"],
            registry=registry,
        )
        self._in_flight = Gauge(
            f"{METRIC_PREFIX}_requests_under_way",
            "Calls whose answer has not ended, streams of events too.",
            registry=registry,
        )
        registry.register(_LoadCollector(gateway, admission))
        registry.register(_Connections(gateway.connections, admission))

    def on_request_start(self) -> None:
        self._in_flight.inc()

    def on_request_end(self, call: RequestRecord) -> None:
        self._in_flight.dec()
        self._requests.labels(call.method, call.route, str(call.status)).inc()
        if call.first_byte_seconds is not None:
            self._seconds.labels(call.method, call.route).observe(call.first_byte_seconds)
        if call.received_bytes:
            self._received.labels(call.route).inc(call.received_bytes)


class _LoadCollector(Collector):
    """Read at each scrape: the queue (every gateway tells the same), and what this one receives."""

    def __init__(self, gateway: GatewayContext, admission: AdmissionControl) -> None:
        self._queue_metrics = QueueMetrics(gateway.catalog)
        self._admission = admission

    def describe(self) -> Iterable[Metric]:
        return []  # or registering would look at the catalog

    def collect(self) -> Iterable[Metric]:
        receiving = GaugeMetricFamily(
            f"{METRIC_PREFIX}_receiving", "Files that are being received.", labels=["kind"]
        )
        for kind in UploadKind:
            receiving.add_metric([kind.name.lower()], self._admission.active_uploads(kind))
        yield receiving
        free = self._admission.disk.free_bytes()
        if free is not None:
            yield GaugeMetricFamily(
                f"{METRIC_PREFIX}_disk_free_bytes",
                "Of the disks that Placewise writes to itself.",
                free,
            )
        queue = self._queue_metrics.job_counts()
        yield GaugeMetricFamily(
            f"{METRIC_PREFIX}_catalog_up",
            "1 where the catalog could be asked.",
            float(queue is not None),
        )
        if queue is None:
            return
        jobs = GaugeMetricFamily(
            f"{METRIC_PREFIX}_jobs",
            "Jobs that are not finished, and failed ones that are kept. Waiting: for a vocabulary, "
            "for descriptors, for search, for disk space.",
            labels=["kind", "state"],
        )
        oldest = GaugeMetricFamily(
            f"{METRIC_PREFIX}_oldest_job_seconds",
            "Seconds since the oldest job of this kind and state was made.",
            labels=["kind", "state"],
        )
        for group in queue:
            jobs.add_metric([group.kind, group.state], group.count)
            oldest.add_metric([group.kind, group.state], group.oldest_seconds)
        yield jobs
        yield oldest


class _Connections(Collector):
    """Read at each scrape: the gateway's open connections, and those that it closed."""

    def __init__(self, connections: Connections, room: AdmissionControl) -> None:
        self._connections = connections
        self._room = room

    def collect(self) -> Iterable[Metric]:
        yield GaugeMetricFamily(
            f"{METRIC_PREFIX}_connections", "Open connections.", self._connections.count
        )
        yield GaugeMetricFamily(
            f"{METRIC_PREFIX}_event_streams",
            "Event streams under way.",
            self._room.event_streams.count,
        )
        closed = CounterMetricFamily(
            f"{METRIC_PREFIX}_connections_closed",
            "Connections that were refused, or closed because of a limit.",
            labels=["reason"],
        )
        for reason, count in self._connections.closed.items():
            closed.add_metric([reason], count)
        yield closed


@router.get("/metrics", operation_id="metrics", response_class=Response)
def read_metrics(request: Request) -> Response:
    """Prometheus' text format; on METRICS_PORT the same without a key."""
    registry: CollectorRegistry = request.app.state.gateway.registry
    return Response(generate_latest(registry), media_type=METRICS_CONTENT_TYPE)
