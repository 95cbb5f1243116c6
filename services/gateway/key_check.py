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

from services.gateway.keys import Authenticator, Caller
from shared.api_keys import Scope as KeyScope
from shared.errors import Forbidden, PlacewiseError
from shared.problems import problem_response

log = logging.getLogger(__name__)

# Probes, and descriptions of the service: none of them tells what is stored.
PUBLIC_PATHS = frozenset(
    {
        "/",
        "/livez",
        "/readyz",
        "/docs",
        "/redoc",
        "/openapi.json",
    }
)
PUBLIC_PATH_PREFIX = "/console/"  # the page's own files, which has a field for the key

# Only describes: `AuthenticationMiddleware` is what asks for the key, before a route is looked for.
BEARER_SCHEME = HTTPBearer(
    auto_error=False,
    scheme_name="key",
    description="A key with the scope that the call names. The embedded Placewise on loopback "
    "needs none, unless ADMIN_KEY is set.",
)


class AuthenticationMiddleware:
    """Answers 401 to a call without a key, whatever it asks for: not even which paths exist. Where
    none is needed, 403 to a page of elsewhere.
    """

    def __init__(self, app: ASGIApp, authenticator: Authenticator) -> None:
        self._app = app
        self._authenticator = authenticator

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or _is_public(scope["path"]):
            await self._app(scope, receive, send)
            return
        request = Request(scope)
        try:
            caller = await self._authenticator.authenticate(request.headers)
        except PlacewiseError as error:
            log.debug("%s %s: %s", request.method, request.url.path, error.code)
            await problem_response(error, request)(scope, receive, send)
            return
        request.state.caller = caller
        try:
            await self._app(scope, receive, send)
        finally:
            await self._authenticator.record_use(caller)


def _is_public(path: str) -> bool:
    return path in PUBLIC_PATHS or path.startswith(PUBLIC_PATH_PREFIX)


def get_caller(request: Request) -> Caller:
    """Who makes the call."""
    caller: Caller = request.state.caller
    return caller


def _require_scope(
    request: Request,
    scopes: SecurityScopes,
    _documented_scheme: Annotated[object, Security(BEARER_SCHEME)],
) -> None:
    lacking = set(scopes.scopes) - get_caller(request).scopes
    if lacking:
        raise Forbidden(
            "scope_missing",
            f"This call needs a key with the scope {', '.join(sorted(lacking))}; yours may "
            f"{', '.join(sorted(get_caller(request).scopes))}. An admin makes one: placewise keys "
            "create.",
            needed=sorted(lacking),
        )


READ = Security(_require_scope, scopes=[KeyScope.READ.value])
WRITE = Security(_require_scope, scopes=[KeyScope.WRITE.value])
ADMIN = Security(_require_scope, scopes=[KeyScope.ADMIN.value])


def check_declared_scopes(router: APIRouter) -> None:
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
