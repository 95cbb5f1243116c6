"""The OpenTelemetry tracer; the only module that imports the OpenTelemetry SDK."""

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

MAX_SPAN_LINKS = 64  # per span; most backends drop further ones


class OpenTelemetryTracer:
    """Exports spans in the background, over OTLP/HTTP or to `exporter`."""

    def __init__(self, service: str, endpoint: str | None, exporter: SpanExporter | None) -> None:
        if exporter is None:
            assert endpoint is not None
            # By the OTLP specification, the base endpoint is shared, and each signal adds its path.
            exporter = OTLPSpanExporter(endpoint=f"{endpoint.rstrip('/')}/v1/traces")
        # The SDK adds OTEL_RESOURCE_ATTRIBUTES and reads OTEL_EXPORTER_OTLP_HEADERS and the like.
        resource = Resource.create({"service.name": f"placewise-{service}"})
        self._provider = TracerProvider(resource=resource)
        self._provider.add_span_processor(BatchSpanProcessor(exporter))
        self._tracer = self._provider.get_tracer("placewise")
        self._propagator = TraceContextTextMapPropagator()

    @contextlib.contextmanager
    def span(
        self, name: str, parents: Sequence[str], attributes: dict[str, Attribute]
    ) -> Iterator[SpanUpdate]:
        parent_context = context.get_current()
        links: list[Link] = []
        if len(parents) == 1:
            parent_context = self._propagator.extract({"traceparent": parents[0]}, parent_context)
        elif parents:
            links = [Link(self._span_context(p)) for p in dict.fromkeys(parents)][:MAX_SPAN_LINKS]
        with self._tracer.start_as_current_span(
            name, context=parent_context, links=links, attributes=attributes
        ) as current:

            def update(name: str, **attributes: Attribute) -> None:
                current.update_name(name)
                current.set_attributes(attributes)

            yield update

    def traceparent(self) -> str | None:
        carrier: dict[str, str] = {}
        self._propagator.inject(carrier)
        return carrier.get("traceparent")

    def close(self) -> None:
        self._provider.shutdown()

    def _span_context(self, traceparent: str) -> SpanContext:
        extracted = self._propagator.extract({"traceparent": traceparent}, context.Context())
        return trace.get_current_span(extracted).get_span_context()
