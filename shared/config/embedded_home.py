"""The folder of an embedded Placewise: who serves it, and where that server listens."""

from __future__ import annotations

import contextlib
import json
import logging
import os
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
    """A server as whoever may read its folder finds it."""

    url: str
    key: str | None = field(default=None, repr=False)
    """Good until that server ends; None where no key is needed."""


def server_address_file(home: Path) -> Path:
    """Says where the server that holds the lock listens, and a key for this user's commands."""
    return home / "server.json"


def find_running_server(home: Path) -> RunningServer | None:
    """The server that serves the folder now, or None."""
    if not _lock_file(home).exists():
        return None
    with contextlib.suppress(Timeout), FileLock(_lock_file(home), timeout=0, mode=FILE_MODE):
        return None
    with contextlib.suppress(FileNotFoundError, ValueError, KeyError):
        said = json.loads(server_address_file(home).read_text())
        return RunningServer(said["url"], said.get("key"))
    return None


def running_server_url(home: Path) -> str | None:
    """The address of the server that serves the folder now, or None."""
    running = find_running_server(home)
    return running.url if running else None


@contextlib.contextmanager
def lock_home(home: Path) -> Iterator[None]:
    """The folder for this process alone; Misconfigured (`home_in_use`, `home_unwritable`)."""
    try:
        make_private_folder(home)
        lock = FileLock(_lock_file(home), timeout=0, mode=FILE_MODE)
        lock.acquire()
    except Timeout:
        where = running_server_url(home) or "another process"
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
def announce_server(home: Path, url: str, key: str | None = None) -> Iterator[None]:
    """While the block runs, this user's commands find the server at `url` through its folder."""
    said = {"url": url, "pid": os.getpid()} | ({"key": key} if key else {})
    try:
        write_private(server_address_file(home), json.dumps(said))
    except OSError as error:
        if error.errno not in DISK_FULL:
            raise
        server_address_file(home).unlink(missing_ok=True)  # of a killed server
        log.warning(
            "the disk of %s is full: commands don't find this server by its folder, and need "
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
