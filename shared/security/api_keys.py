"""Keys of the HTTP API: what one looks like, what it may do, and when none is needed.

A key is 32 random bytes. A plain SHA-256 of it is what the catalog keeps: slow hashes and salts
protect what people choose, and nobody can try out 2**256 keys. It costs a microsecond a call, and
whoever reads the catalog or a backup finds no key that could be used.
"""

from __future__ import annotations

import hashlib
import ipaddress
import secrets
from collections.abc import Collection
from enum import StrEnum

API_KEY_PREFIX = "pw_"  # so that people and secret scanners know one when they see it
KEY_BYTES = 32
SHOWN_PREFIX_CHARACTERS = 11  # of a key, in lists: enough to know it by, and 48 of its 256 bits


class Scope(StrEnum):
    """What a key may do. None of the first two implies the other: a camera only writes."""

    READ = "read"  # look at photos, jobs and figures, and ask which place a photo shows
    WRITE = "write"  # put in, change and delete photos; fit, evaluate, make maps
    ADMIN = "admin"  # everything, also keys and webhooks


ALL_SCOPES = frozenset(Scope)


def expand_scopes(scopes: Collection[Scope]) -> frozenset[Scope]:
    """What a key with these scopes may do."""
    return ALL_SCOPES if Scope.ADMIN in scopes else frozenset(scopes)


def generate_api_key() -> str:
    return API_KEY_PREFIX + secrets.token_urlsafe(KEY_BYTES)


def generate_local_key() -> str:
    """A key for the commands of the user who runs the server, good until it ends."""
    return f"{API_KEY_PREFIX}local_{secrets.token_urlsafe(KEY_BYTES)}"


def api_key_prefix(key: str) -> str:
    """The part of a key that lists show."""
    return key[:SHOWN_PREFIX_CHARACTERS]


def hash_api_key(key: str) -> str:
    """SHA-256, hexadecimal."""
    return hashlib.sha256(key.encode()).hexdigest()


def is_loopback(host: str) -> bool:
    """Does only this machine reach the address? A name that isn't `localhost` may lead anywhere."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"
