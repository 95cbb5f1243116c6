"""The one module that speaks to OpenTelemetry's SDK."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence

from opentelemetry import context, trace
from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
from opentelemetry.sdk.resources import Resource
from opentelemetry.sdk.trace import TracerProvider
from opentelemetry.sdk.trace.export import BatchSpanProcessor, SpanExporter
from opentelemetry.trace import Link, SpanContext
from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

from shared.telemetry.tracing import Attribute, SpanUpdate

MAX_SPAN_LINKS = 64  # of a span: more are cut off by most backends anyway


class OpenTelemetryTracer:
    """Sends spans over OTLP/HTTP in the background, or to `exporter`."""

    def __init__(self, service: str, endpoint: str | None, exporter: SpanExporter | None) -> None:
        if exporter is None:
            assert endpoint is not None
            # The standard's: the general address is that of every signal, and each adds its path.
            exporter = OTLPSpanExporter(endpoint=f"{endpoint.rstrip('/')}/v1/traces")
        # The SDK adds OTEL_RESOURCE_ATTRIBUTES, and reads OTEL_EXPORTER_OTLP_HEADERS and its kind.
        resource = Resource.create({"service.name": f"placewise-{service}"})
        self._provider = TracerProvider(resource=resource)
        self._provider.add_span_processor(BatchSpanProcessor(exporter))
        self._tracer = self._provider.get_tracer("placewise")
        self._propagator = TraceContextTextMapPropagator()

    @contextlib.contextmanager
    def span(
        self, name: str, parents: Sequence[str], attributes: dict[str, Attribute]
    ) -> Iterator[SpanUpdate]:
        around = context.get_current()
        links: list[Link] = []
        if len(parents) == 1:
            around = self._propagator.extract({"traceparent": parents[0]}, around)
        elif parents:
            links = [Link(self._context(one)) for one in dict.fromkeys(parents)][:MAX_SPAN_LINKS]
        with self._tracer.start_as_current_span(
            name, context=around, links=links, attributes=attributes
        ) as made:

            def describe(name: str, **attributes: Attribute) -> None:
                made.update_name(name)
                made.set_attributes(attributes)

            yield describe

    def traceparent(self) -> str | None:
        carrier: dict[str, str] = {}
        self._propagator.inject(carrier)
        return carrier.get("traceparent")

    def close(self) -> None:
        self._provider.shutdown()

    def _context(self, traceparent: str) -> SpanContext:
        read = self._propagator.extract({"traceparent": traceparent}, context.Context())
        return trace.get_current_span(read).get_span_context()
