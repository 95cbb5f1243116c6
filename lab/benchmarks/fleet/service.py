"""A service of a fleet in a process of its own, which can be killed and paused."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Mapping
from pathlib import Path

import httpx2

from tests.support.processes import Process, start
from tests.support.servers.daemon import cpu_seconds_of

START_TIMEOUT_SECONDS = 120.0
STOP_TIMEOUT_SECONDS = 60.0


class ServiceProcess:
    """A service process with a supervisor.

    It is ready when `ready_url` returns 200; a service without HTTP writes `ready_line` instead.
    While `should_run` is set, `restart_if_exited` restarts it, as an orchestrator would.
    `executed`: see tests/support/processes.py.
    """

    def __init__(
        self,
        name: str,
        command: list[str],
        environment: Mapping[str, str],
        log: Path,
        ready_url: str | None,
        ready_line: str = "",
        *,
        executed: bool = True,
    ) -> None:
        self.name = name
        self.environment = dict(environment)
        self.log_path = log
        self.ready_url = ready_url
        self.ready_line = ready_line.encode()
        self.should_run = False
        self._command = command
        self._executed = executed
        self._process: Process | None = None
        self._lock = threading.Lock()
        self._log_begin = 0  # where the log of this start begins

    @property
    def running(self) -> bool:
        return self._process is not None and self._process.poll() is None

    def start(self) -> None:
        with self._lock:
            self.should_run = True
            self._start()

    def restart_if_exited(self) -> bool:
        """Restart the process if it should run but has exited; return whether it was restarted."""
        with self._lock:
            if not self.should_run or self.running:
                return False
            self._start()
            return True

    def _start(self) -> None:
        with self.log_path.open("ab") as log:
            self._log_begin = log.tell()
            self._process = start(
                self._command,
                env=self.environment,
                cwd=self.log_path.parent,  # where no developer's .env lies
                stdout=log,
                stderr=log,
                executed=self._executed,
            )

    def kill(self) -> None:
        """Send SIGKILL, without restart."""
        with self._lock:
            self.should_run = False
            if self._process is not None:
                if self.running:
                    # One that is stopped would not be continued by anybody else.
                    self._process.send_signal(signal.SIGCONT)
                self._process.kill()
                self._process.wait()

    def stop(self) -> int:
        """Send SIGTERM and wait; return the exit code."""
        with self._lock:
            self.should_run = False
            assert self._process is not None
            self._process.terminate()
            return self._process.wait(timeout=STOP_TIMEOUT_SECONDS)

    def pause(self) -> None:
        self._signal(signal.SIGSTOP)

    def resume(self) -> None:
        self._signal(signal.SIGCONT)

    def _signal(self, number: signal.Signals) -> None:
        assert self._process is not None
        self._process.send_signal(number)

    def wait_until_ready(self) -> None:
        """Wait for readiness; on timeout raise AssertionError with the end of the log."""
        deadline = time.monotonic() + START_TIMEOUT_SECONDS
        while not self._ready():
            assert time.monotonic() < deadline, f"{self.name} is not ready: {self.log()}"
            time.sleep(0.1)

    def _ready(self) -> bool:
        if self.ready_url is None:
            return self.running and self.ready_line in self._log_since_start()
        with contextlib.suppress(httpx2.TransportError):
            return httpx2.get(self.ready_url, timeout=5).is_success
        return False

    def cpu_seconds(self) -> float:
        """Return user and system time of the process and its children so far."""
        assert self._process is not None, f"{self.name} was not started"
        return cpu_seconds_of(self._process.pid)

    def _log_since_start(self) -> bytes:
        with self.log_path.open("rb") as log:
            log.seek(self._log_begin)
            return log.read()

    def log(self) -> str:
        return self.log_path.read_text(errors="replace")[-3000:]
