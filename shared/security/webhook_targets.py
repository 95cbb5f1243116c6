"""Where a webhook may lead: to the public internet, and to no machine of our own.

Whoever may make webhooks must not reach through them what only the steward reaches: databases,
admin pages, the metadata service of a cloud. A name is looked up each time before it is connected
to, and the connection goes to the very address that was checked: what the name means a moment later
(DNS rebinding) makes no difference.
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
NAT64 = ipaddress.ip_network("64:ff9b::/96")  # RFC 6052: an IPv4 address in its last 32 bits
# Of protocols and not of machines (RFC 6890); the standard library calls parts of them global.
NON_PUBLIC_NETWORKS = tuple(
    map(ipaddress.ip_network, ("192.0.0.0/24", "192.88.99.0/24", "64:ff9b:1::/48"))
)

Address = ipaddress.IPv4Address | ipaddress.IPv6Address


@dataclass(frozen=True, slots=True)
class WebhookTarget:
    """The parts of a webhook's URL that a connection needs."""

    scheme: str
    host: str
    port: int
    path: str
    """With its query; what goes into the request line."""

    @property
    def host_header(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return host if self.port == DEFAULT_PORTS[self.scheme] else f"{host}:{self.port}"


def parse_webhook_url(url: str, *, allow_private: bool) -> WebhookTarget:
    """The URL's parts. Unprocessable (`invalid_field_error`) for what no webhook may be: it
    needs HTTPS,
    unless private addresses are allowed, and holds no user, password or fragment."""
    schemes = ("https", "http") if allow_private else ("https",)
    if len(url) > MAX_URL_CHARACTERS or not re.fullmatch(r"[!-~]+", url):
        raise invalid_field_error(
            "url", f"has at most {MAX_URL_CHARACTERS} ASCII characters, no blanks"
        )
    try:
        parts = urlsplit(url)
        port, host = parts.port, parts.hostname
    except ValueError:
        raise invalid_field_error("url", "is no address") from None
    if parts.scheme not in schemes or not host:
        raise invalid_field_error("url", f"begins with {' or '.join(schemes)}:// and names a host")
    if parts.username is not None or parts.password is not None or parts.fragment:
        raise invalid_field_error("url", "holds no user, no password and no fragment")
    if port == 0:
        raise invalid_field_error("url", "has no port 0")
    path = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
    return WebhookTarget(parts.scheme, host, port or DEFAULT_PORTS[parts.scheme], path)


def resolve_webhook_target(target: WebhookTarget, *, allow_private: bool) -> str:
    """An address that the target may be connected at, now.

    Raises Unprocessable (`webhook_address_forbidden`) where one of the name's addresses is not
    public, also if others are, and PlacewiseError (`webhook_name_unknown`) where it has none.
    """
    try:
        found = socket.getaddrinfo(target.host, target.port, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError) as error:
        raise PlacewiseError(
            "webhook_name_unknown", f"{target.host} has no address: {error}"
        ) from error
    addresses = [str(entry[4][0]) for entry in found]
    if not allow_private:
        for address in addresses:
            if not is_public_address(ipaddress.ip_address(address)):
                raise Unprocessable(
                    "webhook_address_forbidden",
                    f"{target.host} leads to {address}, which is no public address. Webhooks to "
                    "machines of one's own need WEBHOOK_PRIVATE_ADDRESSES.",
                )
    return addresses[0]


def is_public_address(address: Address) -> bool:
    """Is it a machine of the internet, whichever way the address is written?"""
    if isinstance(address, ipaddress.IPv6Address):
        inner = _embedded_ipv4(address)
        if inner is not None:
            return is_public_address(inner)
        if address.scope_id is not None or address.is_site_local:
            return False
    if any(address in network for network in NON_PUBLIC_NETWORKS):
        return False
    return address.is_global and not (
        address.is_multicast or address.is_reserved or address.is_unspecified
    )


def _embedded_ipv4(address: ipaddress.IPv6Address) -> ipaddress.IPv4Address | None:
    """The IPv4 address that an IPv6 one leads to: mapped, NAT64, 6to4, Teredo."""
    if address.ipv4_mapped is not None:
        return address.ipv4_mapped
    if address in NAT64:
        return ipaddress.IPv4Address(int(address) & 0xFFFFFFFF)
    if address.sixtofour is not None:
        return address.sixtofour
    return address.teredo[1] if address.teredo is not None else None
