"""What every answer says to browsers, whoever makes it: a route, a refusal, a fault.

A route may say something else of itself: the page on `/` and the descriptions do.
"""

from __future__ import annotations

from starlette.datastructures import MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from services.gateway.context import API_PREFIX
from shared.settings import Settings

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
