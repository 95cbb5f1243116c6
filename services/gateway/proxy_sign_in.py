"""Sign-in by a trusted proxy: a user's name and groups from the headers of its requests.

A company's identity provider stays the business of a proxy such as oauth2-proxy. Only connections
from SIGN_IN_PROXIES are believed, by the address of the connection itself and never by a header;
the same headers from anybody else are ignored. Requests with an API key are authenticated by it,
also through the proxy.
"""

from __future__ import annotations

from dataclasses import dataclass
from ipaddress import IPv4Network, IPv6Network, ip_network

from starlette.datastructures import Headers

from services.gateway.authentication import Authenticator, Caller, check_same_origin
from services.http_connections import is_in_networks
from shared.config.settings import Settings
from shared.errors import Unauthorized
from shared.security.api_keys import Scope, expand_scopes

# Those of oauth2-proxy; any proxy can be configured to send them.
USER_HEADER, GROUPS_HEADER = "X-Forwarded-User", "X-Forwarded-Groups"
ANY_GROUP = "*"
MAX_USER_CHARACTERS = 200


@dataclass(frozen=True, slots=True)
class _ProxySignIn:
    """Authenticates users whom a trusted proxy has signed in; others as `keys` does."""

    keys: Authenticator
    networks: tuple[IPv4Network | IPv6Network, ...]
    """Networks of the trusted proxies."""
    scopes_by_group: dict[str, frozenset[Scope]]
    """Scopes of each group; those of ANY_GROUP belong to every user."""
    trusted_origins: tuple[str, ...] = ()

    async def authenticate(self, headers: Headers, peer: str | None = None) -> Caller:
        """Return the user, or the caller of the request's key.

        Raises:
            Unauthorized: `proxy_user_invalid` for an empty, repeated or too long name; and as
                `keys` raises.
            Forbidden: `foreign_page` for a web page of another origin, whose requests a browser
                sends with the cookie of the proxy.
        """
        if (
            "authorization" in headers
            or USER_HEADER not in headers
            or not is_in_networks(peer or "", self.networks)
        ):
            return await self.keys.authenticate(headers, peer)
        names = headers.getlist(USER_HEADER)
        if len(names) != 1 or not 0 < len(names[0].strip()) <= MAX_USER_CHARACTERS:
            raise Unauthorized(
                "proxy_user_invalid",
                f"The proxy's header {USER_HEADER} must have one name of at most "
                f"{MAX_USER_CHARACTERS} characters. Let the proxy replace the header of the "
                "client.",
            )
        check_same_origin(headers, self.trusted_origins)
        groups = [
            group.strip() for value in headers.getlist(GROUPS_HEADER) for group in value.split(",")
        ]
        scopes: set[Scope] = set()
        for group in (*groups, ANY_GROUP):
            scopes |= self.scopes_by_group.get(group, frozenset())
        return Caller(f"user {names[0].strip()}", expand_scopes(scopes))


def with_proxy_sign_in(keys: Authenticator, settings: Settings) -> Authenticator:
    """Return an authenticator that also accepts users of SIGN_IN_PROXIES, if that is set."""
    if not settings.sign_in_networks:
        return keys
    return _ProxySignIn(
        keys,
        tuple(map(ip_network, settings.sign_in_networks)),
        settings.sign_in_scopes_by_group,
        settings.allowed_origins,
    )
