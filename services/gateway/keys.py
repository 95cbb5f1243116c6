"""Who may call: by the key in `Authorization`, or, where there is none, from this machine."""

from __future__ import annotations

import hmac
import re
from typing import Protocol
from urllib.parse import urlsplit

from starlette.datastructures import Headers

from shared.admin_key import hash_key, is_loopback
from shared.errors import Forbidden, Misconfigured, Unauthorized
from shared.settings import Settings

# RFC 6750 in one line; a scheme's name is written in any case (RFC 9110).
BEARER = re.compile(r"bearer +(?P<key>[!-~]+) *", re.IGNORECASE)
HOW = "send the header `Authorization: Bearer KEY` (the commands: PLACEWISE_KEY=KEY)"


class Keys(Protocol):
    """Decides about every call before it reaches a route. Asked on the event loop: no waiting."""

    def check(self, headers: Headers) -> None:
        """Raise Unauthorized (`key_missing`, `key_unknown`) unless `Authorization` holds a key, and
        Forbidden (`foreign_page`) where none is asked for and a browser's page of elsewhere calls.
        """


class NoKeys:
    """This machine's users may call: only they reach the server, and pages in their browsers.

    A page of elsewhere must not. What it sends names it in `Origin`; where it has its own name lead
    to this machine, that name is in `Host`.
    """

    def check(self, headers: Headers) -> None:
        host = headers.get("host", "")
        origin = headers.get("origin", f"http://{host}")
        if not is_loopback(_name(host)) or origin.partition("://")[2] != host:
            raise Forbidden(
                "foreign_page",
                "Without a key only calls to localhost are answered, and no page of elsewhere may "
                "make them in a browser. Set ADMIN_KEY to let others in.",
            )


def _name(host: str) -> str:
    """The name or the address in a `Host` header."""
    try:
        return (urlsplit(f"//{host}").hostname or "").rstrip(".")
    except ValueError:  # an unfinished IPv6 address
        return ""


class KnownKeys:
    """A few keys, each of which may do everything. Only their hashes are held."""

    def __init__(self, *sha256: str) -> None:
        """`sha256` in hexadecimal, as `hash_key` makes it."""
        self._known = sha256

    def check(self, headers: Headers) -> None:
        shown = hash_key(read_bearer(headers.get("authorization")))
        # In constant time: how long a refusal takes says nothing of how near a guess was.
        if not any(hmac.compare_digest(shown, known) for known in self._known):
            raise Unauthorized("key_unknown", f"This is not a key of this server: {HOW}.")


def read_bearer(authorization: str | None) -> str:
    """The key in an `Authorization` header; Unauthorized (`key_missing`) when there is none."""
    found = BEARER.fullmatch(authorization or "")
    if found is None:
        raise Unauthorized("key_missing", f"This server wants its key: {HOW}.")
    return found["key"]


def keys_of(settings: Settings) -> Keys:
    """The keys of a gateway that keeps nothing: ADMIN_KEY, or none on loopback.

    Raises Misconfigured (`admin_key_missing`) beyond loopback without one.
    """
    if settings.admin_key is not None:
        return KnownKeys(hash_key(settings.admin_key.get_secret_value()))
    if is_loopback(settings.host):
        return NoKeys()
    raise Misconfigured(
        "admin_key_missing",
        f"HOST is {settings.host}: others can reach this address, and every call needs a key. Set "
        "ADMIN_KEY; this makes one: openssl rand -hex 24",
    )
