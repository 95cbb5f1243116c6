"""The key is asked for before anything else: before the route, and before the body is read.

What the caller may do is asked by the route, which declares its scope once:

    @router.get("/maps", dependencies=[READ])
"""

from __future__ import annotations

import logging
from typing import Annotated

from fastapi import APIRouter, Request, Security
from fastapi.params import Security as SecurityParameter
from fastapi.routing import APIRoute
from fastapi.security import HTTPBearer, SecurityScopes
from starlette.types import ASGIApp, Receive, Scope, Send

from services.gateway.keys import Caller, Keys
from shared.api_keys import Scope as KeyScope
from shared.errors import Forbidden, PlacewiseError
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

# Only describes: `KeyCheck` is what asks for the key, before a route is looked for.
BEARER = HTTPBearer(
    auto_error=False,
    scheme_name="key",
    description="A key with the scope that the call names. The embedded Placewise on loopback "
    "needs none, unless ADMIN_KEY is set.",
)


class KeyCheck:
    """Answers 401 to a call without a key, whatever it asks for: not even which paths exist. Where
    none is needed, 403 to a page of elsewhere.
    """

    def __init__(self, app: ASGIApp, keys: Keys) -> None:
        self._app = app
        self._keys = keys

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or _is_open(scope["path"]):
            await self._app(scope, receive, send)
            return
        request = Request(scope)
        try:
            caller = await self._keys.check(request.headers)
        except PlacewiseError as error:
            log.debug("%s %s: %s", request.method, request.url.path, error.code)
            await problem_response(error, request)(scope, receive, send)
            return
        request.state.caller = caller
        try:
            await self._app(scope, receive, send)
        finally:
            await self._keys.note_use(caller)


def _is_open(path: str) -> bool:
    return path in OPEN_PATHS or path.startswith(OPEN_FOLDER)


def caller_of(request: Request) -> Caller:
    """Who makes the call."""
    caller: Caller = request.state.caller
    return caller


def _require_scope(
    request: Request, scopes: SecurityScopes, _described: Annotated[object, Security(BEARER)]
) -> None:
    lacking = set(scopes.scopes) - caller_of(request).scopes
    if lacking:
        raise Forbidden(
            "scope_missing",
            f"This call needs a key with the scope {', '.join(sorted(lacking))}; yours may "
            f"{', '.join(sorted(caller_of(request).scopes))}. An admin makes one: placewise keys "
            "create.",
            needed=sorted(lacking),
        )


READ = Security(_require_scope, scopes=[KeyScope.READ.value])
WRITE = Security(_require_scope, scopes=[KeyScope.WRITE.value])
ADMIN = Security(_require_scope, scopes=[KeyScope.ADMIN.value])


def check_scopes(router: APIRouter) -> None:
    """Every call declares its one scope: a route that forgets it can't be served."""
    for route in router.routes:
        if not isinstance(route, APIRoute):
            continue
        declared = [
            dependency
            for dependency in route.dependencies
            if isinstance(dependency, SecurityParameter)
        ]
        if len(declared) != 1:
            raise AssertionError(
                f"{route.path} declares {len(declared)} scopes: give it exactly one, "
                "dependencies=[READ], [WRITE] or [ADMIN]"
            )
