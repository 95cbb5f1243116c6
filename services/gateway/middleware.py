"""What every answer says to browsers, whoever makes it: a route, a refusal, a fault.

A route may say something else of itself: the page on `/` and the descriptions do.

A limit on bodies that are read whole: JSON. Forms with files, and manifests, have theirs as they
stream.

What nobody has foreseen becomes a 500 that says nothing but where to look.

It stands inside of what adds headers. The framework's own handler of unforeseen errors stands
outside of everything, and its answer would lack them.
"""

from __future__ import annotations

from collections.abc import Container

from fastapi import Request
from starlette.datastructures import MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from services.gateway.dependencies import API_PREFIX
from shared.config.settings import Settings
from shared.errors import TooLarge
from shared.http.problem_details import handle_unexpected_error, problem_response

SECURITY_HEADERS = {
    # An answer of the API is no page: where a browser shows one, nothing in it may run or load.
    "Content-Security-Policy": "default-src 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}
# What one key may see is for no cache that others share. Pictures say how long they may be kept.
PRIVATE_CACHE_CONTROL = "private, no-store"


class SecurityHeadersMiddleware:
    """Adds what an answer does not say itself."""

    def __init__(self, app: ASGIApp, settings: Settings) -> None:
        self._app = app
        self._headers = dict(SECURITY_HEADERS)
        if settings.hsts_seconds:
            self._headers["Strict-Transport-Security"] = f"max-age={settings.hsts_seconds}"
        if settings.allowed_origins:
            # CORS decides who may read; the browser must not refuse them before it does.
            self._headers["Cross-Origin-Resource-Policy"] = "cross-origin"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def add(message: Message) -> None:
            if message["type"] == "http.response.start":
                said = MutableHeaders(scope=message)
                for name, value in self._headers.items():
                    said.setdefault(name, value)
                if scope["path"].startswith(API_PREFIX):
                    said.setdefault("Cache-Control", PRIVATE_CACHE_CONTROL)
            await send(message)

        await self._app(scope, receive, add)


MAX_JSON_BYTES = 1_000_000


class BodySizeLimitMiddleware:
    """Answers 413 (`body_too_large`) to a JSON body over the limit, without reading its rest."""

    def __init__(self, app: ASGIApp, exempt_paths: Container[str] = ()) -> None:
        """Paths in `exempt_paths` have a limit of their own for every kind of body."""
        self._app = app
        self._exempt_paths = exempt_paths

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or _is_multipart(scope) or scope["path"] in self._exempt_paths:
            await self._app(scope, receive, send)
            return
        size = 0

        async def counted() -> Message:
            nonlocal size
            message = await receive()
            size += len(message.get("body", b""))
            # To the route it looks as if the client had gone; what it answers is replaced.
            return message if size <= MAX_JSON_BYTES else {"type": "http.disconnect"}

        async def guarded(message: Message) -> None:
            if size <= MAX_JSON_BYTES:
                await send(message)
            elif message["type"] == "http.response.start":
                error = TooLarge(
                    "body_too_large", f"A body that is no form has at most {MAX_JSON_BYTES} bytes."
                )
                await problem_response(error, Request(scope))(scope, receive, send)

        await self._app(scope, counted, guarded)


def _is_multipart(scope: Scope) -> bool:
    return any(
        name == b"content-type" and value.lower().startswith(b"multipart/")
        for name, value in scope["headers"]
    )


class ExceptionHandlerMiddleware:
    """Answers for a route that has failed before it began to answer."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        begun = False

        async def watched(message: Message) -> None:
            nonlocal begun
            begun = begun or message["type"] == "http.response.start"
            await send(message)

        try:
            await self._app(scope, receive, watched)
        except Exception as error:
            answer = await handle_unexpected_error(Request(scope), error)
            if begun:  # half an answer can't be taken back: the connection ends with it
                raise
            await answer(scope, receive, send)
