"""The key is asked for before anything else: before the route, and before the body is read."""

from __future__ import annotations

import logging

from fastapi import Request
from starlette.types import ASGIApp, Receive, Scope, Send

from services.gateway.keys import Keys
from shared.errors import Forbidden, Unauthorized
from shared.problems import problem_response

log = logging.getLogger(__name__)

# Probes, and descriptions of the service: none of them tells what is stored.
OPEN_PATHS = frozenset(
    {
        "/",
        "/livez",
        "/readyz",
        "/docs",
        "/redoc",
        "/openapi.json",
    }
)
OPEN_FOLDER = "/console/"  # the page's own files, which has a field for the key


class KeyCheck:
    """Answers 401 to a call without a key, whatever it asks for: not even which paths exist. Where
    none is needed, 403 to a page of elsewhere.
    """

    def __init__(self, app: ASGIApp, keys: Keys) -> None:
        self._app = app
        self._keys = keys

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http" and not _is_open(scope["path"]):
            request = Request(scope)
            try:
                self._keys.check(request.headers)
            except (Forbidden, Unauthorized) as error:
                log.debug("%s %s: %s", request.method, request.url.path, error.code)
                await problem_response(error, request)(scope, receive, send)
                return
        await self._app(scope, receive, send)


def _is_open(path: str) -> bool:
    return path in OPEN_PATHS or path.startswith(OPEN_FOLDER)
