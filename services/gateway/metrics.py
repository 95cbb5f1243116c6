"""What Prometheus reads of a gateway: its calls, what it receives, and the queue in the catalog."""

from __future__ import annotations

from collections.abc import Iterable

from fastapi import APIRouter, Request, Response
from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from services.call_log import Call
from services.gateway.context import Gateway
from services.gateway.queue_look import QueueLook
from services.gateway.room import Kind, Room
from services.http_connections import Connections
from shared.telemetry.metrics_server import CONTENT_TYPE

router = APIRouter(tags=["operations"])

# From a probe to the longest `Prefer: wait`.
SECONDS = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0)
PREFIX = "placewise_gateway"


class GatewayMetrics:
    """One gateway's figures. Labels are route templates, never paths: there are few of them."""

    def __init__(self, gateway: Gateway, room: Room) -> None:
        registry = gateway.registry
        self._requests = Counter(
            f"{PREFIX}_requests",
            "Calls by route and by the answer's status.",
            ["method", "route", "status"],
            registry=registry,
        )
        self._seconds = Histogram(
            f"{PREFIX}_request_seconds",
            "Seconds from a call to the first byte of its answer.",
            ["method", "route"],
            buckets=SECONDS,
            registry=registry,
        )
        self._received = Counter(
            f"{PREFIX}_received_bytes",
            "Bytes of the bodies of calls: uploads and query photos, nearly all of them.",
            ["route"],
            registry=registry,
        )
        self._under_way = Gauge(
            f"{PREFIX}_requests_under_way",
            "Calls whose answer has not ended, streams of events too.",
            registry=registry,
        )
        registry.register(_Fullness(gateway, room))
        registry.register(_Connections(gateway.connections, room))

    def begun(self) -> None:
        self._under_way.inc()

    def ended(self, call: Call) -> None:
        self._under_way.dec()
        self._requests.labels(call.method, call.route, str(call.status)).inc()
        if call.begun_seconds is not None:
            self._seconds.labels(call.method, call.route).observe(call.begun_seconds)
        if call.received_bytes:
            self._received.labels(call.route).inc(call.received_bytes)


class _Fullness(Collector):
    """Read at each scrape: the queue (every gateway tells the same), and what this one receives."""

    def __init__(self, gateway: Gateway, room: Room) -> None:
        self._look = QueueLook(gateway.catalog)
        self._room = room

    def describe(self) -> Iterable[Metric]:
        return []  # or registering would look at the catalog

    def collect(self) -> Iterable[Metric]:
        receiving = GaugeMetricFamily(
            f"{PREFIX}_receiving", "Files that are being received.", labels=["kind"]
        )
        for kind in Kind:
            receiving.add_metric([kind.name.lower()], self._room.being_received(kind))
        yield receiving
        free = self._room.disk.free_bytes()
        if free is not None:
            yield GaugeMetricFamily(
                f"{PREFIX}_disk_free_bytes", "Of the disks that Placewise writes to itself.", free
            )
        queue = self._look.look()
        yield GaugeMetricFamily(
            f"{PREFIX}_catalog_up", "1 where the catalog could be asked.", float(queue is not None)
        )
        if queue is None:
            return
        jobs = GaugeMetricFamily(
            f"{PREFIX}_jobs",
            "Jobs that are not finished, and failed ones that are kept. Waiting: for a vocabulary, "
            "for descriptors, for search, for disk space.",
            labels=["kind", "state"],
        )
        oldest = GaugeMetricFamily(
            f"{PREFIX}_oldest_job_seconds",
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

    def __init__(self, connections: Connections, room: Room) -> None:
        self._connections = connections
        self._room = room

    def collect(self) -> Iterable[Metric]:
        yield GaugeMetricFamily(
            f"{PREFIX}_connections", "Open connections.", self._connections.count
        )
        yield GaugeMetricFamily(
            f"{PREFIX}_event_streams", "Event streams under way.", self._room.event_streams.count
        )
        closed = CounterMetricFamily(
            f"{PREFIX}_connections_closed",
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
    return Response(generate_latest(registry), media_type=CONTENT_TYPE)
