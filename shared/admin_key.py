"""The admin key of an embedded Placewise: made once, shown once, kept as a hash.

Where ADMIN_KEY is set, that one is in force and nothing is stored. Else the first start beyond
loopback makes one and leaves its SHA-256 under PLACEWISE_HOME, so that clients keep working after
a restart while no file and no backup holds a key that could be used.
"""

from __future__ import annotations

import hashlib
import ipaddress
import re
import secrets
from dataclasses import dataclass, field
from pathlib import Path

from pydantic import SecretStr

from shared.errors import Misconfigured
from shared.home import write_private

PREFIX = "pw_"  # so that people and secret scanners know one when they see it
KEY_BYTES = 32


@dataclass(frozen=True, slots=True)
class AdminKey:
    """The key in force."""

    sha256: str
    """Hexadecimal."""
    made: str | None = field(default=None, repr=False)
    """The key itself, where this start has made it: to be shown now or never."""


def admin_key_file(home: Path) -> Path:
    return home / "admin-key.sha256"


def admin_key(home: Path, chosen: SecretStr | None, new: bool) -> AdminKey:
    """The key that is chosen (ADMIN_KEY), else the one made earlier, else a new one.

    `new` makes one in any case, and the old one is no longer good. Raises Misconfigured:
    `admin_key_chosen` for a new one beside a chosen one, `admin_key_unreadable`.
    """
    if chosen is not None:
        if new:
            raise Misconfigured(
                "admin_key_chosen",
                "ADMIN_KEY is set, and that key is in force: change it there, or unset it.",
            )
        return AdminKey(hash_key(chosen.get_secret_value()))
    file = admin_key_file(home)
    try:
        if file.exists() and not new:
            return AdminKey(_read(file))
        made = PREFIX + secrets.token_urlsafe(KEY_BYTES)
        write_private(file, hash_key(made) + "\n")
    except OSError as error:
        raise Misconfigured(
            "admin_key_unreadable",
            f"Can't use the admin key's file {file}: {error.strerror}. Check its permissions, or "
            "set ADMIN_KEY.",
        ) from error
    return AdminKey(hash_key(made), made)


def new_local_key() -> str:
    """A key for the commands of the user who runs the server, good until it ends."""
    return f"{PREFIX}local_{secrets.token_urlsafe(KEY_BYTES)}"


def hash_key(key: str) -> str:
    """SHA-256, hexadecimal. Keys are long and random: a plain hash tells nothing of them."""
    return hashlib.sha256(key.encode()).hexdigest()


def is_loopback(host: str) -> bool:
    """Does only this machine reach the address? A name that isn't `localhost` may lead anywhere."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"


def _read(file: Path) -> str:
    text = file.read_text(errors="replace").strip()
    if not re.fullmatch(r"[0-9a-f]{64}", text):
        raise Misconfigured(
            "admin_key_unreadable",
            f"{file} does not hold the hash of a key. Delete it, and the next start makes a new "
            "key; or set ADMIN_KEY.",
        )
    return text
