"""A limit on bodies that are read whole: JSON. Forms with files, and manifests, have theirs as they
stream."""

from __future__ import annotations

from collections.abc import Container

from fastapi import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from shared.errors import TooLarge
from shared.problems import problem_response

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
