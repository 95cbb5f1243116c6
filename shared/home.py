"""The folder of an embedded Placewise: who serves it, and where that server listens."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator
from pathlib import Path

from filelock import FileLock, Timeout

from shared.errors import Misconfigured


def address_file(home: Path) -> Path:
    """Says where the server that holds the lock listens."""
    return home / "server.json"


def address_of_running(home: Path) -> str | None:
    """The address of the server that serves the folder now, or None."""
    if not _lock_file(home).exists():
        return None
    with contextlib.suppress(Timeout), FileLock(_lock_file(home), timeout=0):
        return None
    with contextlib.suppress(FileNotFoundError, ValueError, KeyError):
        url: str = json.loads(address_file(home).read_text())["url"]
        return url
    return None


@contextlib.contextmanager
def lock_home(home: Path) -> Iterator[None]:
    """The folder for this process alone; Misconfigured (`home_in_use`, `home_unwritable`)."""
    try:
        home.mkdir(parents=True, exist_ok=True)
        lock = FileLock(_lock_file(home), timeout=0)
        lock.acquire()
    except Timeout:
        where = address_of_running(home) or "another process"
        raise Misconfigured(
            "home_in_use",
            f"The folder {home} is served already, by {where}. Use that server, stop it, or give "
            "this one another PLACEWISE_HOME.",
        ) from None
    except OSError as error:
        raise Misconfigured(
            "home_unwritable",
            f"Can't write into the folder {home}: {error.strerror}. Check its permissions, or "
            "choose another PLACEWISE_HOME.",
        ) from error
    try:
        yield
    finally:
        lock.release()


@contextlib.contextmanager
def announced(home: Path, url: str) -> Iterator[None]:
    """While the block runs, others find the server at `url` through its folder."""
    address_file(home).write_text(json.dumps({"url": url, "pid": os.getpid()}))
    try:
        yield
    finally:
        address_file(home).unlink(missing_ok=True)


def _lock_file(home: Path) -> Path:
    return home / "server.lock"
