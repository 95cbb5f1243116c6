"""OpenTelemetry traces, where OTEL_EXPORTER_OTLP_ENDPOINT is set; otherwise nothing of it is
imported and a span costs next to nothing.

A trace leads from a request through its job to the transaction that ends it: the job's row carries
its W3C `traceparent`. https://www.w3.org/TR/trace-context/
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from contextvars import ContextVar
from typing import TYPE_CHECKING, Protocol

from shared.errors import Misconfigured
from shared.settings import Settings

if TYPE_CHECKING:
    from opentelemetry.sdk.trace.export import SpanExporter

Attribute = str | int | float | bool | Sequence[str]


class SpanUpdate(Protocol):
    """Says of a span under way what it is after all."""

    def __call__(self, name: str, **attributes: Attribute) -> object: ...


class Tracer(Protocol):
    """What `configure_tracing` puts in the place of doing nothing."""

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
    """The block as a span. `parents` are `traceparent`s that it comes from: of one, it is a child;
    with several (a batch of many requests' jobs) it is linked to all. Without any it is a child of
    the span around it. What the block raises is noted in the span."""
    if _tracer is None:
        yield _ignore_update
        return
    known = [parent for parent in parents if parent is not None]
    given = {key: value for key, value in attributes.items() if value is not None}
    with _tracer.span(name, known, given) as describe:
        parent = _tracer.traceparent()
        token = _trace_id.set(parent.split("-")[1] if parent else None)
        try:
            yield describe
        finally:
            _trace_id.reset(token)


def _ignore_update(name: str, **attributes: Attribute) -> None:
    pass


def current_traceparent() -> str | None:
    """The span at hand as a W3C `traceparent`; None where nothing is traced."""
    return _tracer.traceparent() if _tracer is not None else None


def current_trace_id() -> str | None:
    """32 hexadecimal digits; None where nothing is traced."""
    return _trace_id.get()


def configure_tracing(
    settings: Settings, service: str, exporter: SpanExporter | None = None
) -> contextlib.AbstractContextManager[None]:
    """Trace this process while the block runs, and send what is left at its end.

    `exporter` takes the place of the one that sends to OTEL_EXPORTER_OTLP_ENDPOINT. Raises
    Misconfigured (`otel_missing`) where that is set and the extra `otel` is not installed.
    """
    if settings.otel_exporter_otlp_endpoint is None and exporter is None:
        return contextlib.nullcontext()
    try:
        from shared.telemetry.opentelemetry_tracer import OpenTelemetryTracer
    except ModuleNotFoundError as error:
        raise Misconfigured(
            "otel_missing",
            f"OTEL_EXPORTER_OTLP_ENDPOINT is set, and the package {error.name} is not installed. "
            "Install the extra `otel` (uv pip install '.[otel]'; in images it is there), or unset "
            "it.",
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
