"""A server's process on this machine, which never outlives the tests."""

from __future__ import annotations

import contextlib
import os
import random
import shutil
import signal
import socket
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import psutil

from tests.support.servers.handle import wait_until

START_SECONDS = 60.0
STOP_SECONDS = 60.0  # SeaweedFS takes half of it

# Below the ports that systems give to outgoing connections: no such connection takes one of these
# while its server is down.
PORTS = range(18_000, 32_000)

# Each process that runs tests has some of them to itself, and gives none out twice: between the
# choice of a port and the server's start nothing keeps it.
WORKERS = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
WORKER = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
_fresh = random.sample(PORTS[WORKER::WORKERS], len(PORTS[WORKER::WORKERS]))

# Waits for the end of its input, which is the end of the tests, however they end. In a session of
# its own: Ctrl-C is for the tests, which may still need the servers to end in good order.
WATCH = 'cat > /dev/null; kill -9 "$1" 2> /dev/null; rm -rf "$2"'


def new_folder(name: str) -> Path:
    """An empty folder. Not pytest's: the path of a Unix socket may have 107 characters."""
    return Path(tempfile.mkdtemp(prefix=f"pw-{name}-"))


def free_ports(count: int) -> list[int]:
    found: list[int] = []
    with contextlib.ExitStack() as held:
        while len(found) < count:
            port = _fresh.pop()
            listener = held.enter_context(socket.socket())
            with contextlib.suppress(OSError):
                listener.bind(("127.0.0.1", port))
                found.append(port)
    return found


def as_nobody() -> list[str]:
    """What goes before a command that refuses root."""
    return ["setpriv", "--reuid=nobody", "--clear-groups"] if os.geteuid() == 0 else []


def cpu_seconds_of(pid: int) -> float:
    """User and system time so far of a process, its children, and those of them that have ended."""
    total = 0.0
    first = psutil.Process(pid)
    for one in (first, *first.children(recursive=True)):
        with contextlib.suppress(psutil.NoSuchProcess):
            times = one.cpu_times()
            total += times.user + times.system + times.children_user + times.children_system
    return total


def has_ended(process: psutil.Process) -> bool:
    """Also where nobody asks how: in a container the first process may never do so."""
    try:
        return process.status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True


@dataclass
class Daemon:
    """One server. `folder` is its own, and goes with it."""

    name: str
    command: Sequence[str]
    folder: Path
    answers: Callable[[], bool]
    stop_signal: signal.Signals = signal.SIGTERM
    _process: subprocess.Popen[bytes] | None = field(default=None, init=False)
    _watcher: subprocess.Popen[bytes] | None = field(default=None, init=False)

    def start(self) -> None:
        with self._log.open("ab") as log:
            process = self._process = subprocess.Popen(
                self.command,
                cwd=self.folder,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
        self._watcher = subprocess.Popen(
            ["sh", "-c", WATCH, "watch", str(process.pid), str(self.folder)],
            stdin=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        wait_until(
            self.answers,
            START_SECONDS,
            lambda: None if process.poll() is None else self.log(),
            self.name,
        )

    def stop(self) -> None:
        process = self._running()
        process.send_signal(self.stop_signal)
        process.wait(timeout=STOP_SECONDS)
        self._ended()

    def kill(self) -> None:
        process = self._running()
        # PostgreSQL's backends end by themselves, but later: until then it can't start again.
        family = list(self._family()) if process.poll() is None else []
        for one in family:
            with contextlib.suppress(psutil.NoSuchProcess):
                one.kill()
        process.wait()
        wait_until(
            lambda: all(has_ended(one) for one in family),
            STOP_SECONDS,
            lambda: None,
            f"the end of {self.name}",
        )
        self._ended()

    def pause(self) -> None:
        for process in self._family():
            with contextlib.suppress(psutil.NoSuchProcess):  # a child that has ended since
                process.suspend()

    def resume(self) -> None:
        for process in self._family():
            with contextlib.suppress(psutil.NoSuchProcess):
                process.resume()

    def cpu_seconds(self) -> float:
        return cpu_seconds_of(self._running().pid)

    def close(self) -> None:
        if self._process is not None:
            self.kill()
        shutil.rmtree(self.folder, ignore_errors=True)

    def log(self) -> str:
        return self._log.read_text(errors="replace")[-3000:]

    @property
    def _log(self) -> Path:
        return self.folder / "server.log"

    def _running(self) -> subprocess.Popen[bytes]:
        assert self._process is not None, f"{self.name} does not run"
        return self._process

    def _family(self) -> Iterator[psutil.Process]:
        """The first process first: it could start others."""
        first = psutil.Process(self._running().pid)
        yield first
        yield from first.children(recursive=True)

    def _ended(self) -> None:
        self._process = None
        assert self._watcher is not None
        assert self._watcher.stdin is not None
        self._watcher.kill()
        self._watcher.stdin.close()
        self._watcher.wait()
        self._watcher = None
