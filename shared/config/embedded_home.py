"""The folder of an embedded Placewise: its lock, and the address of the server that serves it."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from filelock import FileLock, Timeout

from shared.config.disk_space import DISK_FULL
from shared.config.private_files import FILE_MODE, make_private_folder, write_private
from shared.errors import Misconfigured

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class RunningServer:
    """Address of a running server, as its folder gives it."""

    url: str
    key: str | None = field(default=None, repr=False)
    """API key, valid until that server ends; None where no key is needed."""


def server_address_file(home: Path) -> Path:
    """The file with the server's URL and an API key for the commands of the same user."""
    return home / "server.json"


def find_running_server(home: Path, wait_seconds: float = 0) -> RunningServer | None:
    """Return the server that serves the folder now or, if one starts, in `wait_seconds`."""
    deadline, lock = time.monotonic() + wait_seconds, _lock_file(home)
    with contextlib.suppress(PermissionError):
        while lock.exists():
            with contextlib.suppress(Timeout), FileLock(lock, timeout=0, mode=FILE_MODE):
                return None
            with contextlib.suppress(FileNotFoundError, ValueError, KeyError):
                address = json.loads(server_address_file(home).read_text())
                return RunningServer(address["url"], address.get("key"))
            if time.monotonic() >= deadline:
                return None
            time.sleep(0.1)
    return None


@contextlib.contextmanager
def lock_home(home: Path) -> Iterator[None]:
    """Lock the folder for this process while the block runs.

    Raises:
        Misconfigured: `home_in_use`, `home_unwritable`.
    """
    try:
        make_private_folder(home)
        lock = FileLock(_lock_file(home), timeout=0, mode=FILE_MODE)
        lock.acquire()
    except Timeout:
        running = find_running_server(home)
        user = running.url if running else "another process"
        raise Misconfigured(
            "home_in_use",
            f"The folder {home} is already in use by {user}. Use that server, stop it, or set "
            "another PLACEWISE_HOME.",
        ) from None
    except OSError as error:
        raise Misconfigured(
            "home_unwritable",
            f"Can't write to the folder {home}: {error.strerror}. Check its permissions, or "
            "set another PLACEWISE_HOME.",
        ) from error
    try:
        yield
    finally:
        lock.release()


@contextlib.contextmanager
def announce_server(home: Path, url: str, key: str | None = None) -> Iterator[None]:
    """Write the server's URL and key to its folder while the block runs, for local commands."""
    address = {"url": url, "pid": os.getpid()} | ({"key": key} if key else {})
    try:
        write_private(server_address_file(home), json.dumps(address))
    except OSError as error:
        if error.errno not in DISK_FULL:
            raise
        server_address_file(home).unlink(missing_ok=True)  # may be left over from a killed server
        log.warning(
            "the disk of %s is full: commands can't find this server by its folder and need "
            "--server %s",
            home,
            url,
        )
    try:
        yield
    finally:
        server_address_file(home).unlink(missing_ok=True)


def _lock_file(home: Path) -> Path:
    return home / "server.lock"
