"""Authentication by API key, and authorization by scopes.

`AuthenticationMiddleware` authenticates a request before it is routed and before its body is read:
by the API key in `Authorization`, or, on a loopback address without ADMIN_KEY, by its origin alone.

A route declares exactly one required scope:

    @router.get("/maps", dependencies=[READ])
"""

from __future__ import annotations

import hmac
import logging
import re
from collections.abc import Container
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Annotated, Protocol
from urllib.parse import urlsplit
from uuid import UUID

from fastapi import Request, Security
from fastapi.security import HTTPBearer, SecurityScopes
from sqlalchemy.exc import SQLAlchemyError
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from services.http_server import PEER_ADDRESS
from shared.catalog.api_keys import ApiKey, KeyLimits, authenticate_api_key, record_key_use
from shared.catalog.database.errors import to_unavailable
from shared.catalog.database.session import Catalog
from shared.catalog.maps import DEFAULT_MAP
from shared.errors import Forbidden, PlacewiseError, Unauthorized
from shared.http.problem_details import problem_response
from shared.security.api_keys import ALL_SCOPES, expand_scopes, hash_api_key, is_loopback
from shared.security.api_keys import Scope as KeyScope

log = logging.getLogger(__name__)

# RFC 6750; the name of the scheme is case-insensitive (RFC 9110).
BEARER_HEADER = re.compile(r"bearer +(?P<key>[!-~]+) *", re.IGNORECASE)
HOW_TO_AUTHENTICATE = (
    "send the header `Authorization: Bearer KEY` (the commands: PLACEWISE_KEY=KEY)"
)
# Headers that proxies add (RFC 9110, RFC 7239, and the de facto ones before them).
FORWARDED = ("Forwarded", "Via", "X-Forwarded-For", "X-Forwarded-Host", "X-Real-IP")
USE_RESOLUTION = timedelta(minutes=1)  # of `last_used_at` of a key


@dataclass(frozen=True, slots=True)
class Caller:
    """The authenticated caller of a request."""

    identity: str
    """Stable for a key, and not secret."""
    scopes: frozenset[KeyScope]
    key_id: UUID | None = None
    """None for keys that are not in the catalog: ADMIN_KEY and the local key of the CLI."""
    limits: KeyLimits = field(default=KeyLimits())
    maps: frozenset[str] | None = None
    """Names of the only maps that the caller may use; None: all maps."""

    def check_map(self, name: str) -> None:
        """Raise Forbidden (`map_not_allowed`) for a map that the caller may not use."""
        if self.maps is not None and name not in self.maps:
            raise Forbidden(
                "map_not_allowed",
                f"This key may only use the maps {', '.join(sorted(self.maps))}; the request is "
                f"about the map {name!r}. Select one with ?map=NAME (commands: --map NAME).",
            )

    def check_all_maps(self) -> None:
        """Raise Forbidden (`map_not_allowed`) if the caller may only use some maps."""
        if self.maps is not None:
            raise Forbidden(
                "map_not_allowed",
                f"This key may only use the maps {', '.join(sorted(self.maps))}; the request is "
                "about all maps.",
            )


class Authenticator(Protocol):
    """Authenticates requests before they are routed."""

    async def authenticate(self, headers: Headers, peer: str | None = None) -> Caller:
        """Return the caller of a request.

        Args:
            peer: Address of the connection, whatever the headers say; None if unknown.

        Raises:
            Unauthorized: `key_missing`, `key_unknown`, `key_revoked` or `key_expired`.
            Forbidden: If no key is required: `foreign_page` for a web page of another origin,
                `forwarded_request` for a proxy.
            Unavailable: The catalog can't be reached.
        """


class LocalhostAuthenticator:
    """Accepts requests of this machine without a key.

    On a loopback address the server is reached only by this machine's users and by web pages in
    their browsers. Pages of other origins are refused: the `Origin` header names them, and the
    `Host` header those that resolve their own name to this machine (DNS rebinding). Requests that
    a proxy forwards are refused as well, because all of them come from loopback.
    """

    def __init__(self, trusted_origins: Container[str] = ()) -> None:
        """`trusted_origins` (CORS_ORIGINS) are origins of web pages that are accepted."""
        self._trusted = trusted_origins

    async def authenticate(self, headers: Headers, peer: str | None = None) -> Caller:
        for name in FORWARDED:
            if name in headers:
                raise Forbidden(
                    "forwarded_request",
                    f"The request was forwarded by a proxy (it has the header {name}). Without a "
                    "key only requests of this machine are accepted, and the origin of forwarded "
                    "requests is unknown. Set ADMIN_KEY and restart Placewise; then every request "
                    "needs a key.",
                )
        host = headers.get("host", "")
        if not is_loopback(_host_name(host)):
            raise Forbidden(
                "foreign_page",
                "Without a key only requests to localhost are accepted; this one is to "
                f"{host[:100]!r} (Host header). Set ADMIN_KEY to accept other host names.",
            )
        check_same_origin(headers, self._trusted)
        return Caller("this machine", ALL_SCOPES)


def check_same_origin(headers: Headers, trusted_origins: Container[str]) -> None:
    """Raise Forbidden (`foreign_page`) if a web page of another origin sends the request."""
    host = headers.get("host", "")
    origin = headers.get("origin", f"http://{host}")
    if origin.partition("://")[2] != host and origin not in trusted_origins:
        raise Forbidden(
            "foreign_page",
            "Without a key web pages of other origins are refused; this one is of "
            f"{origin[:100]!r} (Origin header). Add the origin to CORS_ORIGINS, or send a key.",
        )


def _host_name(host: str) -> str:
    """The host name or address in a `Host` header, without the port."""
    try:
        return (urlsplit(f"//{host}").hostname or "").rstrip(".")
    except ValueError:  # a malformed IPv6 address
        return ""


class ApiKeyAuthenticator:
    """Authenticates with the API keys of the catalog and with fixed admin keys (ADMIN_KEY).

    The catalog is queried for every request, so a revoked key is refused by all gateways as soon as
    the revocation is committed. Admin keys also work while the catalog is unreachable.
    """

    def __init__(self, catalog: Catalog, *admin_sha256: str) -> None:
        """`admin_sha256` are hexadecimal hashes of admin keys (`hash_api_key`)."""
        self._catalog = catalog
        self._admins = admin_sha256

    async def authenticate(self, headers: Headers, peer: str | None = None) -> Caller:
        key_sha256 = hash_api_key(parse_bearer(headers.get("authorization")))
        # In constant time, against timing attacks.
        if any(hmac.compare_digest(key_sha256, admin) for admin in self._admins):
            return Caller("admin", ALL_SCOPES)
        return await run_in_threadpool(self._find_caller, key_sha256)

    def _find_caller(self, sha256: str) -> Caller:
        try:
            with self._catalog.read() as session:
                key = authenticate_api_key(session, sha256)
        except Unauthorized as error:
            raise Unauthorized(
                error.code, f"{error.detail} To authenticate, {HOW_TO_AUTHENTICATE}."
            ) from None
        except SQLAlchemyError as error:
            unavailable = to_unavailable(error)
            if unavailable is None:
                raise
            raise unavailable from error
        self._record_use(key)
        return Caller(
            identity=f"key {key.id}",
            scopes=expand_scopes([KeyScope(scope) for scope in key.scopes]),
            key_id=key.id,
            limits=KeyLimits(key.requests_per_minute, key.max_photos),
            maps=None if key.maps is None else frozenset(key.maps),
        )

    def _record_use(self, key: ApiKey) -> None:
        """Update `last_used_at` at most once a minute; errors are only logged."""
        if key.last_used_at is not None and datetime.now(UTC) - key.last_used_at < USE_RESOLUTION:
            return
        try:
            with self._catalog.write() as session:
                record_key_use(session, key.id)
        except SQLAlchemyError as error:
            log.warning("the use of the key %s was not recorded: %s", key.id, type(error).__name__)


def parse_bearer(authorization: str | None) -> str:
    """Return the key of an `Authorization: Bearer` header.

    Raises:
        Unauthorized: `key_missing`, if the header is missing or malformed.
    """
    match = BEARER_HEADER.fullmatch(authorization or "")
    if match is None:
        raise Unauthorized("key_missing", f"The server requires a key: {HOW_TO_AUTHENTICATE}.")
    return match["key"]


# Health probes, the web page and the API documentation: none of them exposes stored data.
PUBLIC_PATHS = frozenset({"/", "/livez", "/readyz", "/docs", "/redoc", "/openapi.json"})
PUBLIC_PATH_PREFIX = "/console/"  # assets of the web page, where the user enters the key

MAPS_PATH = "/api/v1/maps"

# For the OpenAPI schema only: `AuthenticationMiddleware` checks the key, before routing.
BEARER_SCHEME = HTTPBearer(
    auto_error=False,
    scheme_name="key",
    description="An API key with the required scope. The embedded server on a loopback address "
    "needs no key unless ADMIN_KEY is set.",
)


class AuthenticationMiddleware:
    """Responds 401 to requests without a valid key before routing, also for unknown paths.

    If no key is required, it responds 403 to web pages of other origins.
    """

    def __init__(self, app: ASGIApp, authenticator: Authenticator) -> None:
        self._app = app
        self._authenticator = authenticator

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        path = scope.get("path", "")
        is_public = path in PUBLIC_PATHS or path.startswith(PUBLIC_PATH_PREFIX)
        if scope["type"] != "http" or is_public:
            await self._app(scope, receive, send)
            return
        request = Request(scope)
        try:
            caller = await self._authenticator.authenticate(
                request.headers, scope.get(PEER_ADDRESS)
            )
        except PlacewiseError as error:
            log.debug("%s %s: %s", request.method, request.url.path, error.code)
            await problem_response(error, request)(scope, receive, send)
            return
        request.state.caller = caller
        await self._app(scope, receive, send)


def get_caller(request: Request) -> Caller:
    """Return the authenticated caller of a request."""
    caller: Caller = request.state.caller
    return caller


async def _require_scope(
    request: Request,
    scopes: SecurityScopes,
    _documented_scheme: Annotated[object, Security(BEARER_SCHEME)],
) -> None:
    """Raise Forbidden if the caller lacks a scope, or may not use the request's map."""
    caller = get_caller(request)
    missing = set(scopes.scopes) - caller.scopes
    if missing:
        raise Forbidden(
            "scope_missing",
            f"This request needs the scope {', '.join(sorted(missing))}; the caller has "
            f"{', '.join(sorted(caller.scopes)) or 'none'}. An admin can create a key with it "
            "(placewise keys create), or grant it to users that a proxy signs in (SIGN_IN_SCOPES).",
            needed=sorted(missing),
        )
    # Each request selects its map by the query parameter, except those of /maps, which check it
    # themselves, and those about all maps (`ALL_MAPS`), which refuse such keys.
    if not request.scope["path"].startswith(MAPS_PATH):
        for name in request.query_params.getlist("map") or [DEFAULT_MAP]:
            caller.check_map(name)


READ = Security(_require_scope, scopes=[KeyScope.READ.value])
WRITE = Security(_require_scope, scopes=[KeyScope.WRITE.value])
ADMIN = Security(_require_scope, scopes=[KeyScope.ADMIN.value])
