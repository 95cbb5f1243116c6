"""Distributed tracing with OpenTelemetry, and the id of the current request.

Tracing is on where OTEL_EXPORTER_OTLP_ENDPOINT is set. Otherwise OpenTelemetry is not imported, and
a span costs next to nothing. A trace leads from a request through its job to the transaction that
completes it: the job's row carries the W3C `traceparent` (https://www.w3.org/TR/trace-context/).

The gateway takes the request id from `X-Request-ID` or creates one. It is stored in the job's row,
and the worker runs the job under the same id. Log lines, spans and requests to search carry it.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator, Sequence
from contextvars import ContextVar
from typing import TYPE_CHECKING, Protocol

from shared.config.settings import Settings
from shared.errors import Misconfigured
from shared.ids import new_id

if TYPE_CHECKING:
    from opentelemetry.sdk.trace.export import SpanExporter


Attribute = str | int | float | bool | Sequence[str]


class SpanUpdate(Protocol):
    """Renames the current span and adds attributes to it."""

    def __call__(self, name: str, **attributes: Attribute) -> object: ...


class Tracer(Protocol):
    """The tracer that `configure_tracing` installs."""

    def span(
        self,
        name: str,
        parents: Sequence[str],
        attributes: dict[str, Attribute],
    ) -> contextlib.AbstractContextManager[SpanUpdate]: ...

    def traceparent(self) -> str | None: ...

    def close(self) -> None: ...


_tracer: Tracer | None = None
_trace_id: ContextVar[str | None] = ContextVar("trace_id", default=None)


@contextlib.contextmanager
def span(
    name: str, parents: Sequence[str | None] = (), **attributes: Attribute | None
) -> Iterator[SpanUpdate]:
    """Trace the block as a span; an exception of the block is recorded in it.

    Args:
        name: name of the span.
        parents: `traceparent` values. With one, the span is its child; with several, as for a
            batch of several requests' jobs, it is linked to all. Without any it is a child of the
            current span. None values are ignored.
        attributes: attributes of the span; None values are ignored.

    Yields:
        A function that renames the span and adds attributes.
    """
    if _tracer is None:
        yield _ignore_update
        return
    traceparents = [parent for parent in parents if parent is not None]
    set_attributes = {key: value for key, value in attributes.items() if value is not None}
    with _tracer.span(name, traceparents, set_attributes) as update:
        parent = _tracer.traceparent()
        token = _trace_id.set(parent.split("-")[1] if parent else None)
        try:
            yield update
        finally:
            _trace_id.reset(token)


def _ignore_update(name: str, **attributes: Attribute) -> None:
    pass


def current_traceparent() -> str | None:
    """Return the W3C `traceparent` of the current span; None without tracing."""
    return _tracer.traceparent() if _tracer is not None else None


def current_trace_id() -> str | None:
    """Return the id of the current trace, 32 hexadecimal digits; None without tracing."""
    return _trace_id.get()


def configure_tracing(
    settings: Settings, service: str, exporter: SpanExporter | None = None
) -> contextlib.AbstractContextManager[None]:
    """Trace this process while the block runs, and flush the remaining spans at its end.

    Args:
        settings: OTEL_EXPORTER_OTLP_ENDPOINT turns tracing on.
        service: name of the service in the traces.
        exporter: replaces the OTLP exporter.

    Raises:
        Misconfigured: `otel_missing` where tracing is on without the extra `otel`.
    """
    if settings.otel_exporter_otlp_endpoint is None and exporter is None:
        return contextlib.nullcontext()
    try:
        from shared.telemetry.otlp import OpenTelemetryTracer
    except ModuleNotFoundError as error:
        raise Misconfigured(
            "otel_missing",
            f"OTEL_EXPORTER_OTLP_ENDPOINT is set, but the package {error.name} is not installed. "
            "Install the extra `otel` (uv pip install '.[otel]'; the images include it), or unset "
            "the variable.",
        ) from None
    return _tracing(OpenTelemetryTracer(service, settings.otel_exporter_otlp_endpoint, exporter))


@contextlib.contextmanager
def _tracing(tracer: Tracer) -> Iterator[None]:
    global _tracer
    _tracer = tracer
    try:
        yield
    finally:
        _tracer = None
        tracer.close()


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
