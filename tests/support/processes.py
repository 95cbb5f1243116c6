"""Starts processes: `placewise` ones as forks of a process that has imported everything."""

from __future__ import annotations

import atexit
import contextlib
import errno
import functools
import json
import os
import shlex
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any, Protocol

from shared.config.settings import Settings

PLACEWISE = str(Path(sys.executable).with_name("placewise"))
REPOSITORY = Path(__file__).parents[2]
# What Placewise reads when it starts. All else may have been read by a library at its import.
READ_AT_START = frozenset(
    {name.upper() for name in Settings.model_fields}
    | {"PLACEWISE_SERVER", "PLACEWISE_KEY", "PYTEST_CURRENT_TEST"}
)
# Torch reads it when it first looks for a GPU, not at its import.
READ_AT_FIRST_USE = frozenset({"CUDA_VISIBLE_DEVICES"})
ANSWER_BYTES = 1024
# In Linux's abstract namespace, which needs no file; the same for all workers of pytest-xdist.
ADDRESS = f"\0placewise-tests-{os.environ.get('PYTEST_XDIST_TESTRUNUID', os.getpid())}"
FORK_SERVER = (sys.executable, "-m", "tests.support.fork_server")
LOOK_SECONDS = 0.01


def _inherited() -> dict[str, str]:
    retained = {name: value for name, value in os.environ.items() if name not in READ_AT_START}
    # Where no bytecode is written beside the sources, each start would compile torch anew.
    if retained.get("PYTHONDONTWRITEBYTECODE"):
        folder = tempfile.TemporaryDirectory(prefix="pw-bytecode-", ignore_cleanup_errors=True)
        atexit.register(folder.cleanup)
        retained |= {"PYTHONDONTWRITEBYTECODE": "", "PYTHONPYCACHEPREFIX": folder.name}
    return retained


# The environment of the tests without the developer's settings, as it was before they changed it:
# libraries write into it when a test imports them.
INHERITED = _inherited()


def _before(env: Mapping[str, str]) -> dict[str, str]:
    """The variables that a library may have read when it was imported."""
    late = READ_AT_START | READ_AT_FIRST_USE
    return {name: value for name, value in env.items() if name not in late}


class Process(Protocol):
    """What tests use of subprocess.Popen."""

    @property
    def pid(self) -> int: ...

    def poll(self) -> int | None:
        """The exit code, or minus the signal that ended it; None while it runs."""

    def wait(self, timeout: float | None = None) -> int:
        """As `poll` when it has ended; subprocess.TimeoutExpired after `timeout` seconds."""

    def send_signal(self, sig: int) -> None: ...

    def terminate(self) -> None: ...

    def kill(self) -> None: ...


def start(
    command: Sequence[str | Path],
    *,
    env: Mapping[str, str],
    cwd: Path,
    stdout: IO[Any],
    stderr: IO[Any],
    executed: bool = False,
) -> Process:
    """A process of this command, with nothing to read.

    PLACEWISE, or a program in Python (*.py), is a fork of the fork server, unless `executed` asks
    for a new interpreter, which takes seconds, or `env` has what a library may read at its import.
    """
    words = list(map(str, command))
    in_python = words[0] == PLACEWISE or words[0].endswith(".py")
    forked = in_python and not executed and _before(env) == _before(INHERITED)
    if forked and sys.platform == "linux":
        return _fork_server().start(words, env, cwd, stdout, stderr)
    return subprocess.Popen(
        words, env=env, cwd=cwd, stdin=subprocess.DEVNULL, stdout=stdout, stderr=stderr
    )


def forked_program(path: Path, prefix: str = "") -> Path:
    """Write an executable that runs PLACEWISE as a fork, for scripts that start it themselves.

    `prefix` is a shell command that runs first.
    """
    path.write_text(f'#!/bin/sh\n{prefix}\nexec {forked_command(PLACEWISE)} "$@"\n')
    path.chmod(0o755)
    return path


def forked_command(program: str | Path) -> str:
    """A shell command that runs this program in Python as a fork.

    AssertionError with what the fork server has printed if it could not start.
    """
    _fork_server().ask({})
    client = Path(__file__).with_name("forked_program.py")
    return shlex.join([sys.executable, "-IS", str(client), ADDRESS[1:], str(program)])


class ForkedProcess:
    """A child of the fork server, which keeps its pid until its exit code is read."""

    def __init__(self, server: ForkServer, pid: int, command: list[str]) -> None:
        self.pid = pid
        self._server = server
        self._command = command
        self._code: int | None = None

    def poll(self) -> int | None:
        if self._code is None:
            self._code = self._server.ask({"ended": self.pid})
        return self._code

    def wait(self, timeout: float | None = None) -> int:
        deadline = None if timeout is None else time.monotonic() + timeout
        while (code := self.poll()) is None:
            if deadline is not None and time.monotonic() > deadline:
                assert timeout is not None
                raise subprocess.TimeoutExpired(self._command, timeout)
            time.sleep(LOOK_SECONDS)
        return code

    def send_signal(self, sig: int) -> None:
        if self.poll() is None:
            with contextlib.suppress(
                ProcessLookupError
            ):  # another thread has read the exit code meanwhile
                os.kill(self.pid, sig)

    def terminate(self) -> None:
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


class ForkServer:
    """A connection to tests/support/fork_server.py, which ends with the last of a run's tests.

    The first process of the run that needs the server starts it.
    """

    def __init__(self, environment: Mapping[str, str]) -> None:
        """`environment` is what its libraries see when they are imported."""
        self._lock = threading.Lock()
        self._requests = 0
        self._log = tempfile.TemporaryFile()  # noqa: SIM115, it is open as long as the server runs
        self._process: subprocess.Popen[bytes] | None = None
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with listener, contextlib.suppress(OSError):  # the name is taken: the server runs
            listener.bind(ADDRESS)
            listener.listen()
            self._process = subprocess.Popen(
                [*FORK_SERVER, str(listener.fileno())],
                # OpenBLAS starts its threads at import.
                env={**environment, "OPENBLAS_NUM_THREADS": "1"},
                cwd=REPOSITORY,
                stdin=subprocess.DEVNULL,
                stdout=self._log,
                stderr=self._log,
                pass_fds=[listener.fileno()],
            )
        self._control = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        while self._control.connect_ex(ADDRESS) == errno.ECONNREFUSED:
            time.sleep(LOOK_SECONDS)  # the other process has not listened yet

    def start(
        self,
        command: list[str],
        env: Mapping[str, str],
        cwd: Path,
        stdout: IO[Any],
        stderr: IO[Any],
    ) -> ForkedProcess:
        request = {"command": command, "env": dict(env), "cwd": str(cwd)}
        with open(os.devnull, "rb") as nothing:  # noqa: PTH123
            standard = [nothing.fileno(), stdout.fileno(), stderr.fileno()]
            pid: int = self.ask(request, standard)
        return ForkedProcess(self, pid, command)

    def ask(self, request: dict[str, Any], descriptors: list[int] | None = None) -> Any:
        """One request and its answer; `descriptors` are the standard files of a new process."""
        with self._lock:
            self._requests += 1
            message = json.dumps({**request, "number": self._requests}).encode()
            try:
                socket.send_fds(self._control, [message], descriptors or [])
                while reported := self._control.recv(ANSWER_BYTES):
                    number, answer = json.loads(reported)
                    if number == self._requests:  # others are of interrupted requests
                        return answer
            except OSError:
                pass  # the log says more
        self._log.seek(0)
        raise AssertionError(f"the fork server ended: {self._log.read()[-3000:].decode()}")

    def close(self) -> None:
        """End this process's children that it has not waited for, and the last one the server."""
        self._control.close()
        if self._process is not None:
            self._process.wait()
        self._log.close()


@functools.cache
def _fork_server() -> ForkServer:
    """This test process's connection, from the first start on."""
    server = ForkServer(INHERITED)
    atexit.register(server.close)
    return server
