"""API keys: format, scopes, hashing, and the loopback exemption.

A key is 32 random bytes, and the catalog stores its plain SHA-256. Slow, salted hashes protect
passwords that people choose; a random key of 256 bits can't be guessed. A plain hash costs a
microsecond per request, and a leaked catalog or backup contains no usable key.
"""

from __future__ import annotations

import hashlib
import ipaddress
import secrets
from collections.abc import Collection

from shared.enums import Scope as Scope

API_KEY_PREFIX = "pw_"  # recognised by people and secret scanners
KEY_BYTES = 32
SHOWN_PREFIX_CHARACTERS = 11  # identifies a key in lists; reveals 48 of its 256 bits


ALL_SCOPES = frozenset(Scope)


def expand_scopes(scopes: Collection[Scope]) -> frozenset[Scope]:
    """Return all scopes that these scopes imply."""
    return ALL_SCOPES if Scope.ADMIN in scopes else frozenset(scopes)


def generate_api_key() -> str:
    """Return a new random key."""
    return API_KEY_PREFIX + secrets.token_urlsafe(KEY_BYTES)


def generate_local_key() -> str:
    """Return a new key for local commands of the user who runs the server, valid until it ends."""
    return f"{API_KEY_PREFIX}local_{secrets.token_urlsafe(KEY_BYTES)}"


def api_key_prefix(key: str) -> str:
    """Return the part of a key that is shown in lists."""
    return key[:SHOWN_PREFIX_CHARACTERS]


def hash_api_key(key: str) -> str:
    """Return the SHA-256 of a key, hexadecimal."""
    return hashlib.sha256(key.encode()).hexdigest()


def is_loopback(host: str) -> bool:
    """Return whether only this machine can reach the address; False for names but `localhost`."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"
