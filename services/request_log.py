"""Request logging middleware: request ids, log lines and metrics of HTTP requests."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from shared.errors import Unavailable
from shared.http.problem_details import CLIENT_GONE, REQUEST_ID_SCOPE_KEY, problem_response
from shared.telemetry.request_ids import REQUEST_ID_HEADER, request_id_context, request_id_or_new

log = logging.getLogger(__name__)

NO_ROUTE = "none"  # label of unrouted requests: their paths are unbounded
KNOWN_METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})
SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})


@dataclass(slots=True)
class RequestRecord:
    """A request. `method` and `route` have few values, so they can be metric labels."""

    method: str
    route: str = NO_ROUTE
    """The route template, such as /api/v1/jobs/{job_id}."""
    status: int = 500
    """500 unless a response has started: then the error handler responds."""
    received_bytes: int = 0
    first_byte_seconds: float | None = None
    """Seconds to the first byte of the response; None if none was sent."""


class RequestLogMiddleware:
    """Outermost middleware: assigns the request id, and logs and measures each request.

    The request id is the client's `X-Request-ID` or a new one, and is returned in the response.
    Unsafe methods and 5xx responses are logged at INFO, other requests at DEBUG.

    A request that is still in flight SHUTDOWN_GRACE_SECONDS after the server was stopped gets a 503
    (`stopping`): uvicorn cancels it, and would respond with a 500, which clients don't retry.
    """

    def __init__(
        self,
        app: ASGIApp,
        *,
        quiet: bool = False,
        on_start: Callable[[], object] = lambda: None,
        on_end: Callable[[RequestRecord], object] = lambda record: None,
    ) -> None:
        """Creates the middleware.

        Args:
            quiet: Log all requests except those with 5xx responses at DEBUG.
            on_start: Called when a request starts, for metrics.
            on_end: Called with the record when it has ended, for metrics.
        """
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
        record, started = RequestRecord(method), time.perf_counter()
        request_id = request_id_or_new(headers.get(REQUEST_ID_HEADER))
        # For the handler of unexpected exceptions, which is outside of all middleware.
        scope[REQUEST_ID_SCOPE_KEY] = request_id

        disconnected = False

        async def counted_receive() -> Message:
            nonlocal disconnected
            message = await receive()
            # The client will not receive a response that starts from now on.
            disconnected = disconnected or (
                message["type"] == "http.disconnect" and record.first_byte_seconds is None
            )
            record.received_bytes += len(message.get("body", b""))
            return message

        async def send_with_request_id(message: Message) -> None:
            if message["type"] == "http.response.start":
                record.status = message["status"]
                record.first_byte_seconds = time.perf_counter() - started
                MutableHeaders(scope=message)[REQUEST_ID_HEADER] = request_id
            await send(message)

        self._on_start()
        with request_id_context(request_id):
            try:
                await self._app(scope, counted_receive, send_with_request_id)
            except asyncio.CancelledError:
                if record.first_byte_seconds is not None:
                    raise
                stopping = Unavailable(
                    "stopping", "The server stopped before the request was complete. Repeat it."
                )
                response = problem_response(stopping, Request(scope))
                await response(scope, receive, send_with_request_id)
            finally:
                if disconnected:
                    record.status = CLIENT_GONE
                record.route = _route_template(scope)
                self._on_end(record)
                self._log(record, scope, time.perf_counter() - started)

    def _log(self, record: RequestRecord, scope: Scope, seconds: float) -> None:
        at_info = record.status >= 500 or not (self._quiet or record.method in SAFE_METHODS)
        fields: dict[str, Any] = {
            "route": record.route,
            "status": record.status,
            "seconds": round(seconds, 4),
            "received_bytes": record.received_bytes,
        }
        log.log(
            logging.INFO if at_info else logging.DEBUG,
            "%s %s: %d",
            record.method,
            scope["path"],
            record.status,
            extra=fields,
        )


def _route_template(scope: Scope) -> str:
    """The path template of the matched route, with the prefix of its router.

    `route.path` lacks the prefix, which has no parameters: it is taken from the request's path.
    """
    template: str | None = getattr(scope.get("route"), "path", None)
    if template is None:
        return NO_ROUTE
    parts = scope["path"].split("/")
    prefix = parts[: len(parts) - template.count("/")]
    return "/".join(prefix) + template
