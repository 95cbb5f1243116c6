"""Every HTTP call of a service: its id, its line in the log, its span, its place in the figures."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from shared.http.problem_details import CLIENT_GONE, CLOSED_STATUS_SCOPE_KEY, REQUEST_ID_SCOPE_KEY
from shared.telemetry.tracing import REQUEST_ID_HEADER, request_id_context, request_id_or_new, span

log = logging.getLogger(__name__)

NO_ROUTE = "none"  # of a call that no route takes: its path is anyone's choice
KNOWN_METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})
SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})


@dataclass(slots=True)
class RequestRecord:
    """One call. `method` and `route` are of a few: they may become labels."""

    method: str
    route: str = NO_ROUTE
    """The route's template: /api/v1/jobs/{job_id}."""
    status: int = 500
    """What is answered when no answer has begun: the error handler's."""
    received_bytes: int = 0
    first_byte_seconds: float | None = None
    """Until the answer's first byte; None while there is none."""


class RequestLogMiddleware:
    """The outermost middleware. A call's id is the caller's `X-Request-ID`, or a fresh one; the
    answer carries it. `on_begin` and `on_end` are for the service's figures.

    Calls that may change something and those that fail have their line at INFO, all others at
    DEBUG; where `quiet`, all that do not fail.
    """

    def __init__(
        self,
        app: ASGIApp,
        *,
        quiet: bool = False,
        on_start: Callable[[], object] = lambda: None,
        on_end: Callable[[RequestRecord], object] = lambda call: None,
    ) -> None:
        self._app = app
        self._quiet = quiet
        self._on_start = on_start
        self._on_end = on_end

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        method = scope["method"] if scope["method"] in KNOWN_METHODS else "OTHER"
        call, started = RequestRecord(method), time.perf_counter()
        request_id = request_id_or_new(headers.get(REQUEST_ID_HEADER))
        # For the handler of unforeseen errors, which stands outside of every middleware.
        scope[REQUEST_ID_SCOPE_KEY] = request_id

        gone = False

        async def counted() -> Message:
            nonlocal gone
            message = await receive()
            # Whatever is answered from now on, the client does not get it.
            gone = gone or (
                message["type"] == "http.disconnect" and call.first_byte_seconds is None
            )
            call.received_bytes += len(message.get("body", b""))
            return message

        async def marked(message: Message) -> None:
            if message["type"] == "http.response.start":
                call.status = message["status"]
                call.first_byte_seconds = time.perf_counter() - started
                MutableHeaders(scope=message)[REQUEST_ID_HEADER] = request_id
            await send(message)

        self._on_start()
        with (
            request_id_context(request_id),
            span(method, [headers.get("traceparent")], request_id=request_id) as describe,
        ):
            try:
                await self._app(scope, counted, marked)
            finally:
                if gone or CLOSED_STATUS_SCOPE_KEY in scope:
                    call.status = scope.get(CLOSED_STATUS_SCOPE_KEY, CLIENT_GONE)
                call.route = _route_template(scope)
                describe(f"{method} {call.route}", status=call.status)
                self._on_end(call)
                self._write(call, scope, time.perf_counter() - started)

    def _write(self, call: RequestRecord, scope: Scope, seconds: float) -> None:
        worth = call.status >= 500 or not (self._quiet or call.method in SAFE_METHODS)
        facts: dict[str, Any] = {
            "route": call.route,
            "status": call.status,
            "seconds": round(seconds, 4),
            "received_bytes": call.received_bytes,
        }
        log.log(
            logging.INFO if worth else logging.DEBUG,
            "%s %s: %d",
            call.method,
            scope["path"],
            call.status,
            extra=facts,
        )


def _route_template(scope: Scope) -> str:
    """The path of the route that took the call, with its router's prefix: that is not in the route,
    and is the same in every path."""
    template: str | None = getattr(scope.get("route"), "path", None)
    if template is None:
        return NO_ROUTE
    parts = scope["path"].split("/")
    prefix = parts[: len(parts) - template.count("/")]
    return "/".join(prefix) + template
