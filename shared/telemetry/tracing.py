"""OpenTelemetry traces, where OTEL_EXPORTER_OTLP_ENDPOINT is set; otherwise nothing of it is
imported and a span costs next to nothing.

A trace leads from a request through its job to the transaction that ends it: the job's row carries
its W3C `traceparent`. https://www.w3.org/TR/trace-context/

The id of the request that is being answered, or that the work at hand was asked for by.

The gateway takes it from `X-Request-ID` or makes one. Whoever does a request's job does it under
the same id: it is kept in the job's row. Log lines, spans and calls to search carry it.
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
        from shared.telemetry.otlp import OpenTelemetryTracer
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


REQUEST_ID_HEADER = "X-Request-ID"
MAX_REQUEST_ID_CHARACTERS = 128
# What every log, header and column takes as it stands.
REQUEST_ID_PATTERN = re.compile(rf"[A-Za-z0-9._:/+=@-]{{1,{MAX_REQUEST_ID_CHARACTERS}}}")

_request_id: ContextVar[str | None] = ContextVar("request_id", default=None)


def current_request_id() -> str | None:
    """None outside of a request and its work."""
    return _request_id.get()


def request_id_or_new(sent: str | None) -> str:
    """The caller's id where it can be used as it stands, else a fresh one."""
    return sent if sent is not None and REQUEST_ID_PATTERN.fullmatch(sent) else str(new_id())


@contextlib.contextmanager
def request_id_context(request_id: str | None) -> Iterator[None]:
    """What the block does, it does for that request; None: for nobody's."""
    token = _request_id.set(request_id)
    try:
        yield
    finally:
        _request_id.reset(token)
