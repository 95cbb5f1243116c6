"""Distributed tracing with OpenTelemetry, and the id of the current request.

Tracing is on where OTEL_EXPORTER_OTLP_ENDPOINT is set. Otherwise the spans of `opentelemetry-api`
do nothing. A trace leads from a request through its job to the transaction that completes it: the
job's row carries the W3C `traceparent` (https://www.w3.org/TR/trace-context/).

The gateway takes the request id from `X-Request-ID` or creates one. It is stored in the job's row,
and the worker runs the job under the same id. Log lines, spans and requests to search carry it.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator, Sequence
from contextvars import ContextVar
from typing import TYPE_CHECKING

from opentelemetry.context import Context
from opentelemetry.trace import (
    Link,
    NoOpTracer,
    Span,
    Tracer,
    format_trace_id,
    get_current_span,
)
from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

from shared.config.settings import Settings
from shared.errors import Misconfigured
from shared.ids import new_id

if TYPE_CHECKING:
    from opentelemetry.sdk.trace.export import SpanExporter


Attribute = str | int | float | bool | Sequence[str]

MAX_SPAN_LINKS = 64  # per span; most backends drop further ones

_tracer: Tracer = NoOpTracer()
_propagator = TraceContextTextMapPropagator()


def span(
    name: str, parents: Sequence[str | None] = (), **attributes: Attribute | None
) -> contextlib.AbstractContextManager[Span]:
    """Trace the block as a span; an exception of the block is recorded in it.

    Args:
        parents: `traceparent` values. With one, the span is its child; with several, as for a
            batch of several requests' jobs, it is linked to all. Without any it is a child of the
            current span. None values are ignored.
        attributes: attributes of the span; None values are ignored.
    """
    contexts = [
        _propagator.extract({"traceparent": parent}, Context())
        for parent in dict.fromkeys(parents)
        if parent is not None
    ]
    several = len(contexts) > 1
    links = [Link(get_current_span(context).get_span_context()) for context in contexts]
    return _tracer.start_as_current_span(
        name,
        context=None if several or not contexts else contexts[0],
        links=links[:MAX_SPAN_LINKS] if several else None,
        attributes={key: value for key, value in attributes.items() if value is not None},
    )


def current_traceparent() -> str | None:
    """Return the W3C `traceparent` of the current span; None without tracing."""
    carrier: dict[str, str] = {}
    _propagator.inject(carrier)
    return carrier.get("traceparent")


def current_trace_id() -> str | None:
    """Return the id of the current trace, 32 hexadecimal digits; None without tracing."""
    context = get_current_span().get_span_context()
    return format_trace_id(context.trace_id) if context.is_valid else None


@contextlib.contextmanager
def configure_tracing(
    settings: Settings, service: str, exporter: SpanExporter | None = None
) -> Iterator[None]:
    """Trace this process while the block runs, and flush the remaining spans at its end.

    Args:
        settings: OTEL_EXPORTER_OTLP_ENDPOINT turns tracing on.

    Raises:
        Misconfigured: `otel_missing` where tracing is on without the extra `otel`.
    """
    global _tracer
    endpoint = settings.otel_exporter_otlp_endpoint
    if endpoint is None and exporter is None:
        yield
        return
    try:
        from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
        from opentelemetry.sdk.resources import Resource
        from opentelemetry.sdk.trace import TracerProvider
        from opentelemetry.sdk.trace.export import BatchSpanProcessor
    except ModuleNotFoundError as error:
        raise Misconfigured(
            "otel_missing",
            f"OTEL_EXPORTER_OTLP_ENDPOINT is set, but the package {error.name} is not installed. "
            "Install the extra `otel` (uv pip install '.[otel]'; the images include it), or unset "
            "the variable.",
        ) from None
    if exporter is None:
        # By the OTLP specification, the base endpoint is shared, and each signal adds its path.
        exporter = OTLPSpanExporter(endpoint=f"{str(endpoint).rstrip('/')}/v1/traces")
    # The SDK adds OTEL_RESOURCE_ATTRIBUTES and reads OTEL_EXPORTER_OTLP_HEADERS and the like.
    provider = TracerProvider(resource=Resource.create({"service.name": f"placewise-{service}"}))
    provider.add_span_processor(BatchSpanProcessor(exporter))
    _tracer = provider.get_tracer("placewise")
    try:
        yield
    finally:
        _tracer = NoOpTracer()
        provider.shutdown()


REQUEST_ID_HEADER = "X-Request-ID"
MAX_REQUEST_ID_CHARACTERS = 128
# Safe in every log, header and column without escaping.
REQUEST_ID_PATTERN = re.compile(rf"[A-Za-z0-9._:/+=@-]{{1,{MAX_REQUEST_ID_CHARACTERS}}}")

_request_id: ContextVar[str | None] = ContextVar("request_id", default=None)


def current_request_id() -> str | None:
    """Return the id of the current request; None outside of a request and its jobs."""
    return _request_id.get()


def request_id_or_new(request_id: str | None) -> str:
    """Return the client's request id if it is valid, else a new one."""
    if request_id is not None and REQUEST_ID_PATTERN.fullmatch(request_id):
        return request_id
    return str(new_id())


@contextlib.contextmanager
def request_id_context(request_id: str | None) -> Iterator[None]:
    """Set the current request id while the block runs; None for no request."""
    token = _request_id.set(request_id)
    try:
        yield
    finally:
        _request_id.reset(token)
