"""Validation of webhook URLs, and protection against server-side request forgery (SSRF).

A webhook may only lead to the public internet: otherwise anyone who may create one could reach
what the steward can reach, for example databases, admin pages or a cloud's metadata service. The
host name is resolved before each connection, and the connection uses the very address that was
checked, so that DNS rebinding has no effect.
"""

from __future__ import annotations

import ipaddress
import re
import socket
from dataclasses import dataclass
from urllib.parse import urlsplit

from shared.errors import PlacewiseError, Unprocessable, invalid_field_error

MAX_URL_CHARACTERS = 2000
DEFAULT_PORTS = {"http": 80, "https": 443}
NAT64 = ipaddress.ip_network("64:ff9b::/96")  # RFC 6052: the last 32 bits are an IPv4 address
# Reserved for protocols (RFC 6890); `is_global` of the standard library is True for parts of them.
NON_PUBLIC_NETWORKS = tuple(
    map(ipaddress.ip_network, ("192.0.0.0/24", "192.88.99.0/24", "64:ff9b:1::/48"))
)

Address = ipaddress.IPv4Address | ipaddress.IPv6Address


@dataclass(frozen=True, slots=True)
class WebhookTarget:
    """The parts of a webhook URL that a connection needs."""

    scheme: str
    host: str
    port: int
    path: str
    """Path and query, as in the request line."""

    @property
    def host_header(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return host if self.port == DEFAULT_PORTS[self.scheme] else f"{host}:{self.port}"


def parse_webhook_url(url: str, *, allow_private: bool) -> WebhookTarget:
    """Parse and validate a webhook URL.

    Args:
        url: must use HTTPS unless private addresses are allowed, and must not contain a user,
            password or fragment.

    Raises:
        Unprocessable: `invalid_field` for any other URL.
    """
    schemes = ("https", "http") if allow_private else ("https",)
    if len(url) > MAX_URL_CHARACTERS or not re.fullmatch(r"[!-~]+", url):
        raise invalid_field_error(
            "url", f"must have at most {MAX_URL_CHARACTERS} ASCII characters and no blanks"
        )
    try:
        parts = urlsplit(url)
        port, host = parts.port, parts.hostname
    except ValueError:
        raise invalid_field_error("url", "is not a URL") from None
    if parts.scheme not in schemes or not host:
        needed = f"must begin with {':// or '.join(schemes)}:// and a host"
        private = "" if allow_private else "; WEBHOOK_PRIVATE_ADDRESSES=true allows http://"
        raise invalid_field_error("url", needed + private)
    if parts.username is not None or parts.password is not None or parts.fragment:
        raise invalid_field_error("url", "must not contain a user, a password or a fragment")
    if port == 0:
        raise invalid_field_error("url", "must not have the port 0")
    path = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
    return WebhookTarget(parts.scheme, host, port or DEFAULT_PORTS[parts.scheme], path)


def resolve_webhook_target(target: WebhookTarget, *, allow_private: bool) -> str:
    """Resolve the target's host name; return the IP address to connect to.

    Raises:
        Unprocessable: `webhook_address_forbidden` when one of the addresses is not public, even
            if others are.
        PlacewiseError: `webhook_name_unknown` when the name has no address.
    """
    try:
        address_infos = socket.getaddrinfo(target.host, target.port, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError) as error:
        raise PlacewiseError(
            "webhook_name_unknown", f"{target.host} has no address: {error}"
        ) from error
    addresses = [str(entry[4][0]) for entry in address_infos]
    if not allow_private:
        for address in addresses:
            if not is_public_address(ipaddress.ip_address(address)):
                raise Unprocessable(
                    "webhook_address_forbidden",
                    f"{target.host} resolves to {address}, which is not a public address. To allow "
                    "webhooks to private addresses, set WEBHOOK_PRIVATE_ADDRESSES.",
                )
    return addresses[0]


def is_public_address(address: Address) -> bool:
    """Return whether the address, or an IPv4 address embedded in it, is on the public internet."""
    if isinstance(address, ipaddress.IPv6Address):
        embedded = _embedded_ipv4(address)
        if embedded is not None:
            return is_public_address(embedded)
        if address.scope_id is not None or address.is_site_local:
            return False
    if any(address in network for network in NON_PUBLIC_NETWORKS):
        return False
    return address.is_global and not (
        address.is_multicast or address.is_reserved or address.is_unspecified
    )


def _embedded_ipv4(address: ipaddress.IPv6Address) -> ipaddress.IPv4Address | None:
    """Return the IPv4 address in an IPv6 one: mapped, NAT64, 6to4 or Teredo; else None."""
    if address.ipv4_mapped is not None:
        return address.ipv4_mapped
    if address in NAT64:
        return ipaddress.IPv4Address(int(address) & 0xFFFFFFFF)
    if address.sixtofour is not None:
        return address.sixtofour
    return address.teredo[1] if address.teredo is not None else None
