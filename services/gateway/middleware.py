"""ASGI middleware: security headers, the size limit of bodies, and unexpected exceptions."""

from __future__ import annotations

import re
from collections.abc import Mapping

from fastapi import Request
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from services.gateway.dependencies import API_PREFIX
from shared.config.settings import Settings
from shared.errors import TooLarge
from shared.http.problem_details import handle_unexpected_error

SECURITY_HEADERS = {
    # API responses are not pages: when a browser displays one, it must not run or load anything.
    "Content-Security-Policy": "default-src 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}
# Responses depend on the API key, so shared caches must not store them. Image routes set their own.
PRIVATE_CACHE_CONTROL = "private, no-store"


class SecurityHeadersMiddleware:
    """Adds the security headers, and `Cache-Control` below `/api`, that a response does not set.

    Responses of the web page and of the API documentation set their own.
    """

    def __init__(self, app: ASGIApp, settings: Settings) -> None:
        self._app = app
        self._headers = dict(SECURITY_HEADERS)
        if settings.allowed_origins:
            # CORS decides which origins may read; this header must not block them earlier.
            self._headers["Cross-Origin-Resource-Policy"] = "cross-origin"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in self._headers.items():
                    headers.setdefault(name, value)
                if scope["path"].startswith(API_PREFIX):
                    headers.setdefault("Cache-Control", PRIVATE_CACHE_CONTROL)
            await send(message)

        await self._app(scope, receive, send_with_headers)


MAX_JSON_BYTES = 1_000_000
BYTES_PER_VALUE = 16
"""A body of at most N bytes may have N / 16 values: `[],` takes 64 bytes of memory."""
VALUE_MARKS = (b",", b"[", b"{")


class BodySizeLimitMiddleware:
    """Refuses large bodies that are read into memory (JSON) without reading the rest.

    `body_too_large` for more than MAX_JSON_BYTES, `too_many_values` for more values in them than
    bodies of that size need.

    Args:
        form_paths: Matches the paths of the routes that limit multipart bodies themselves. Any
            other route would read such a body into memory.
        limits: Other limits than MAX_JSON_BYTES, by path.
    """

    def __init__(
        self,
        app: ASGIApp,
        *,
        form_paths: re.Pattern[str],
        limits: Mapping[str, int],
    ) -> None:
        self._app = app
        self._form_paths = form_paths
        self._limits = limits

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or self._is_exempt(scope):
            await self._app(scope, receive, send)
            return
        limit = self._limits.get(scope["path"], MAX_JSON_BYTES)
        max_values = limit // BYTES_PER_VALUE
        size = values = 0

        async def counted_receive() -> Message:
            nonlocal size, values
            message = await receive()
            body = message.get("body", b"")
            size += len(body)
            values += sum(map(body.count, VALUE_MARKS))
            if size > limit:
                raise TooLarge("body_too_large", f"The body is larger than {limit} bytes.")
            if values > max_values:
                while message.get("more_body") and size <= limit:
                    # Many clients read no response before they have sent their body.
                    message = await receive()
                    size += len(message.get("body", b""))
                raise TooLarge(
                    "too_many_values",
                    f"The body has more than {max_values} values. Split it, or send less.",
                )
            return message

        await self._app(scope, counted_receive, send)

    def _is_exempt(self, scope: Scope) -> bool:
        media_type = Headers(scope=scope).get("content-type", "")
        is_form = media_type.lower().startswith("multipart/")
        return is_form and self._form_paths.fullmatch(scope["path"]) is not None


class ExceptionHandlerMiddleware:
    """Converts unhandled exceptions into an opaque 500 with the request id.

    It is inside the middleware that adds headers: Starlette's own handler is outside of all
    middleware, so that its responses would lack them. If the response has already started, the
    exception is raised again and closes the connection.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        response_started = False

        async def watched_send(message: Message) -> None:
            nonlocal response_started
            response_started = response_started or message["type"] == "http.response.start"
            await send(message)

        try:
            await self._app(scope, receive, watched_send)
        except Exception as error:
            response = await handle_unexpected_error(Request(scope), error)
            if response_started:
                raise
            await response(scope, receive, send)
