"""Who may call: what stands in `Authorization` against the keys that a server knows."""

from __future__ import annotations

import hmac
import re
from typing import Protocol

from shared.admin_key import hash_key, is_loopback
from shared.errors import Misconfigured, Unauthorized
from shared.settings import Settings

# RFC 6750 in one line; a scheme's name is written in any case (RFC 9110).
BEARER = re.compile(r"bearer +(?P<key>[!-~]+) *", re.IGNORECASE)
HOW = "send the header `Authorization: Bearer KEY` (the commands: PLACEWISE_KEY=KEY)"


class Keys(Protocol):
    """Decides about every call before it reaches a route. Asked on the event loop: no waiting."""

    def check(self, authorization: str | None) -> None:
        """Raise Unauthorized (`key_missing`, `key_unknown`) unless the header holds a key."""


class NoKeys:
    """Everyone may call: only this machine's users reach the server."""

    def check(self, authorization: str | None) -> None:
        pass


class KnownKeys:
    """A few keys, each of which may do everything. Only their hashes are held."""

    def __init__(self, *sha256: str) -> None:
        """`sha256` in hexadecimal, as `hash_key` makes it."""
        self._known = sha256

    def check(self, authorization: str | None) -> None:
        shown = hash_key(read_bearer(authorization))
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
