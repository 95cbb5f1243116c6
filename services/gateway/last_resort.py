"""What nobody has foreseen becomes a 500 that says nothing but where to look.

It stands inside of what adds headers. The framework's own handler of unforeseen errors stands
outside of everything, and its answer would lack them.
"""

from __future__ import annotations

from fastapi import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from shared.problems import handle_unexpected_error


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
