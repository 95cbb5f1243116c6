"""Who calls, and what they may do: by the key in `Authorization`, or, embedded on loopback without
keys, whoever is on this machine.

The key is asked for before anything else: before the route, and before the body is read.

What the caller may do is asked by the route, which declares its scope once:

    @router.get("/maps", dependencies=[READ])
"""

from __future__ import annotations

import hmac
import logging
import re
import time
from collections.abc import Container
from dataclasses import dataclass, field
from typing import Annotated, Protocol
from urllib.parse import urlsplit
from uuid import UUID

from fastapi import APIRouter, Request, Security
from fastapi.params import Security as SecurityParameter
from fastapi.routing import APIRoute
from fastapi.security import HTTPBearer, SecurityScopes
from sqlalchemy.exc import SQLAlchemyError
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from shared.catalog.api_keys import (
    LAST_USED_RESOLUTION_SECONDS,
    KeyLimits,
    authenticate_api_key,
    record_key_use,
)
from shared.catalog.database_errors import to_unavailable
from shared.catalog.session import Catalog
from shared.errors import Forbidden, PlacewiseError, Unauthorized
from shared.http.problem_details import problem_response
from shared.security.api_keys import ALL_SCOPES, expand_scopes, hash_api_key, is_loopback
from shared.security.api_keys import Scope as KeyScope

log = logging.getLogger(__name__)

# RFC 6750 in one line; a scheme's name is written in any case (RFC 9110).
BEARER_HEADER = re.compile(r"bearer +(?P<key>[!-~]+) *", re.IGNORECASE)
HOW_TO_AUTHENTICATE = (
    "send the header `Authorization: Bearer KEY` (the commands: PLACEWISE_KEY=KEY)"
)
# What proxies add (RFC 9110, RFC 7239, and the usual ones before them).
FORWARDED = ("Forwarded", "Via", "X-Forwarded-For", "X-Forwarded-Host", "X-Real-IP")
MAX_REMEMBERED_USES = 10_000  # keys whose last use this process knows; above that it forgets all


@dataclass(frozen=True, slots=True)
class Caller:
    """Whoever makes a call."""

    identity: str
    """The same for the same key, and no secret."""
    scopes: frozenset[KeyScope]
    key_id: UUID | None = None
    """None for keys that are no row of the catalog: ADMIN_KEY, and that of this user's commands."""
    limits: KeyLimits = field(default=KeyLimits())


class Authenticator(Protocol):
    """Decides about every call before it reaches a route."""

    async def authenticate(self, headers: Headers) -> Caller:
        """Raise Unauthorized (`key_missing`, `key_unknown`, `key_revoked`, `key_expired`) unless
        `Authorization` holds a key, Forbidden (`foreign_page`, `forwarded_request`) where none is
        asked for and a browser's page of elsewhere or a proxy calls, and Unavailable while the
        catalog can't be asked.
        """

    async def record_use(self, caller: Caller) -> None:
        """Called once the call has been answered."""


class LocalhostAuthenticator:
    """This machine's users may call: only they reach the server, and pages in their browsers.

    A page of elsewhere must not. What it sends names it in `ContextFilter`; where it has its
    own name lead
    to this machine (DNS rebinding), that name is in `Host`. Nor must whoever is behind a proxy on
    this machine: to the server, everyone behind it comes from loopback.
    """

    def __init__(self, trusted_origins: Container[str] = ()) -> None:
        """`trusted_origins` (CORS_ORIGINS) name pages of elsewhere that may call."""
        self._trusted = trusted_origins

    async def authenticate(self, headers: Headers) -> Caller:
        for name in FORWARDED:
            if name in headers:
                raise Forbidden(
                    "forwarded_request",
                    f"A proxy has forwarded this call (it has the header {name}). Without a key "
                    "only calls of this machine are answered, and nobody can tell who is behind a "
                    "proxy. Set ADMIN_KEY and restart Placewise; then every call needs a key.",
                )
        host = headers.get("host", "")
        if not is_loopback(_host_name(host)):
            raise Forbidden(
                "foreign_page",
                "Without a key only calls to localhost are answered; this one is to "
                f"{host[:100]!r} (its Host header). Set ADMIN_KEY to answer under other names.",
            )
        origin = headers.get("origin", f"http://{host}")
        if origin.partition("://")[2] != host and origin not in self._trusted:
            raise Forbidden(
                "foreign_page",
                f"Without a key no page of another site may call; this one is of {origin[:100]!r} "
                "(its Origin header). Name the page in CORS_ORIGINS, or set ADMIN_KEY.",
            )
        return Caller("this machine", ALL_SCOPES)

    async def record_use(self, caller: Caller) -> None:
        pass


def _host_name(host: str) -> str:
    """The name or the address in a `Host` header."""
    try:
        return (urlsplit(f"//{host}").hostname or "").rstrip(".")
    except ValueError:  # an unfinished IPv6 address
        return ""


class ApiKeyAuthenticator:
    """The catalog's keys, and a few beside them that may do everything (ADMIN_KEY).

    The catalog is asked at each call: a revoked key opens nothing from that commit on, whichever
    gateway is asked. Those beside it open also while the catalog is away.
    """

    def __init__(self, catalog: Catalog, *admin_sha256: str) -> None:
        """`admin_sha256` in hexadecimal, as `hash_api_key` makes it."""
        self._catalog = catalog
        self._admins = admin_sha256
        self._use_recorded_at: dict[UUID, float] = {}

    async def authenticate(self, headers: Headers) -> Caller:
        shown = hash_api_key(parse_bearer(headers.get("authorization")))
        # In constant time: how long a refusal takes says nothing of how near a guess was.
        if any(hmac.compare_digest(shown, known) for known in self._admins):
            return Caller("admin", ALL_SCOPES)
        return await run_in_threadpool(self._find_caller, shown)

    def _find_caller(self, sha256: str) -> Caller:
        try:
            with self._catalog.read() as session:
                key = authenticate_api_key(session, sha256)
        except Unauthorized as error:
            raise Unauthorized(
                error.code, f"{error.detail} To call: {HOW_TO_AUTHENTICATE}."
            ) from None
        except SQLAlchemyError as error:
            unavailable = to_unavailable(error)
            if unavailable is None:
                raise
            raise unavailable from error
        return Caller(
            identity=f"key {key.id}",
            scopes=expand_scopes([KeyScope(scope) for scope in key.scopes]),
            key_id=key.id,
            limits=KeyLimits(key.requests_per_minute, key.upload_bytes_per_day, key.max_photos),
        )

    async def record_use(self, caller: Caller) -> None:
        """`last_used_at`, at most once a minute for a key; no reason to fail a call."""
        key_id, now = caller.key_id, time.monotonic()
        if (
            key_id is None
            or now - self._use_recorded_at.get(key_id, -LAST_USED_RESOLUTION_SECONDS)
            < LAST_USED_RESOLUTION_SECONDS
        ):
            return
        if len(self._use_recorded_at) >= MAX_REMEMBERED_USES:
            self._use_recorded_at.clear()
        self._use_recorded_at[key_id] = now
        try:
            await run_in_threadpool(self._write_use, key_id)
        except SQLAlchemyError as error:
            log.warning("the use of the key %s was not noted: %s", key_id, error.__class__.__name__)

    def _write_use(self, key_id: UUID) -> None:
        with self._catalog.write() as session:
            record_key_use(session, key_id)


def parse_bearer(authorization: str | None) -> str:
    """The key in an `Authorization` header; Unauthorized (`key_missing`) when there is none."""
    found = BEARER_HEADER.fullmatch(authorization or "")
    if found is None:
        raise Unauthorized("key_missing", f"This server wants its key: {HOW_TO_AUTHENTICATE}.")
    return found["key"]


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
