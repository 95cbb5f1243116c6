"""Starts a complete Placewise on this machine: real servers, and each service in its own process.

    with open_fleet(extractors=3) as fleet:
        fleet.start()
        fleet["extractor-1"].kill()

It needs a checkout with the extra `dev`, because the servers are those of the tests.
"""

from __future__ import annotations

import contextlib
import signal
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self
from urllib.parse import urlsplit

import httpx2
from sqlalchemy.engine import make_url

from shared.catalog.database.schema import migrate
from shared.catalog.database.session import Catalog
from shared.storage import ObjectStore
from shared.storage.s3 import S3Store
from tests.support.fault_injection import FaultProxy
from tests.support.processes import PLACEWISE, Process, start
from tests.support.server import SERVICES_KEY, environment
from tests.support.servers import (
    PostgresServer,
    RedisServer,
    S3Server,
    start_postgres,
    start_redis,
    start_s3,
)
from tests.support.servers.daemon import cpu_seconds_of, free_ports
from tests.support.servers.handle import Handle

START_TIMEOUT_SECONDS = 120.0
STOP_TIMEOUT_SECONDS = 60.0
S3_TIMEOUT_SECONDS = 2.0  # so that a silent store is noticed within a fault
POLL_SECONDS = 0.2


@dataclass(frozen=True, slots=True)
class Servers:
    """The servers of a fleet, each of which can be killed."""

    postgres: PostgresServer
    redis: RedisServer
    s3: S3Server
    processes: dict[str, Handle]
    """By name: PostgreSQL, Redis, the S3 store"""
    proxies: dict[str, FaultProxy]
    """By the same names; services may connect through them"""


@contextlib.contextmanager
def start_servers() -> Iterator[Servers]:
    """Context manager that starts all three servers."""
    with contextlib.ExitStack() as stack:
        postgres = stack.enter_context(start_postgres(own=True))
        redis = stack.enter_context(start_redis(own=True))
        s3 = stack.enter_context(start_s3(own=True))
        processes, proxies = {}, {}
        for name, process, port in (
            ("PostgreSQL", postgres.process, postgres.admin.port),
            ("Redis", redis.process, urlsplit(redis.url).port),
            ("the S3 store", s3.process, urlsplit(f"//{s3.endpoint}").port),
        ):
            assert process is not None, "a server of its own was started"
            assert port is not None
            processes[name] = process
            proxies[name] = stack.enter_context(FaultProxy(free_ports(1)[0], port))
        yield Servers(postgres, redis, s3, processes, proxies)


class ServiceProcess:
    """A service in a process of its own, which can be killed and paused.

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
        self.should_run = False
        self.command = command
        self._ready_url = ready_url
        self._ready_line = ready_line.encode()
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
                self.command,
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

    def signal(self, number: signal.Signals) -> None:
        """Send a signal, such as SIGSTOP."""
        assert self._process is not None
        self._process.send_signal(number)

    def wait_until_ready(self) -> None:
        """Wait for readiness; on timeout raise AssertionError with the end of the log."""
        deadline = time.monotonic() + START_TIMEOUT_SECONDS
        while not self._ready():
            assert time.monotonic() < deadline, f"{self.name} is not ready: {self.log()}"
            time.sleep(0.1)

    def _ready(self) -> bool:
        if self._ready_url is None:
            return (
                self.running and self._ready_line in self.log_path.read_bytes()[self._log_begin :]
            )
        with contextlib.suppress(httpx2.TransportError):
            return httpx2.get(self._ready_url, timeout=5).is_success
        return False

    def cpu_seconds(self) -> float:
        """Return user and system time of the process and its children so far."""
        return cpu_seconds_of(self.pid)

    @property
    def pid(self) -> int:
        assert self._process is not None, f"{self.name} was not started"
        return self._process.pid

    def log(self) -> str:
        return self.log_path.read_text(errors="replace")[-3000:]


class Fleet:
    """Services by name: `gateway-0..`, `extractor-0..`, `search-0..`, `steward-0..`.

    Settings are those of `shared.config.settings`; the default extractor is the tiny test
    extractor.
    """

    def __init__(
        self,
        folder: Path,
        servers: Servers,
        *,
        gateways: int = 1,
        extractors: int = 1,
        replicas: int = 1,
        stewards: int = 1,
        through_proxies: bool = False,
        executed: bool = True,
        **settings: Any,
    ) -> None:
        """Create the fleet without starting it.

        `through_proxies`: connect to the servers through fault proxies, which is slower. Without
        `executed`, services start faster but not as in production: do not measure performance with
        it.
        """
        self._executed = executed
        self._folder = folder
        self.servers = servers
        bucket = servers.s3.new_bucket()
        database_url, redis_url = (
            make_url(url) for url in (servers.postgres.new_database(), servers.redis.url)
        )
        # Ours go past the proxies.
        self.catalog = Catalog(database_url.render_as_string(hide_password=False))
        self.store: ObjectStore = S3Store(bucket)
        s3 = servers.s3
        if through_proxies:
            database_url = database_url.set(port=servers.proxies["PostgreSQL"].port)
            redis_url = redis_url.set(port=servers.proxies["Redis"].port)
            s3 = replace(s3, endpoint=f"127.0.0.1:{servers.proxies['the S3 store'].port}")
        ports = iter(free_ports(gateways + replicas))
        searches = [next(ports) for _ in range(replicas)]
        self.search_urls = [f"http://127.0.0.1:{port}" for port in searches]
        self._settings = {
            "database_url": database_url.render_as_string(hide_password=False),
            "redis_url": redis_url.render_as_string(hide_password=False),
            "admin_key": SERVICES_KEY,
            "search_urls": ",".join(self.search_urls),
            **s3.variables(bucket.name),
            "s3_timeout_seconds": S3_TIMEOUT_SECONDS,
            **settings,
        }
        self.lease_seconds = float(settings.get("lease_seconds", 60.0))
        self.services: dict[str, ServiceProcess] = {}
        for replica, port in enumerate(searches):
            self._add(f"search-{replica}", port)
        self.gateway_urls: list[str] = []
        for number in range(gateways):
            port = next(ports)
            self.gateway_urls.append(f"http://127.0.0.1:{port}")
            self._add(f"gateway-{number}", port)
        for number in range(extractors):
            self._add(f"extractor-{number}", None)
        for number in range(stewards):
            self._add(f"steward-{number}", None)
        self._stop = threading.Event()
        self._supervisor = threading.Thread(target=self._supervise, name="supervisor", daemon=True)
        self.crashed: list[str] = []
        """Services that ended although nobody had killed them, in order."""

    def _add(self, name: str, port: int | None, **settings: Any) -> None:
        service = name.partition("-")[0]
        own = {**self._settings, **settings, **({"port": port} if port else {})}
        self.services[name] = ServiceProcess(
            name,
            [PLACEWISE, service],
            environment(self._folder / "home", **own),
            self._folder / f"{name}.log",
            f"http://127.0.0.1:{port}/readyz" if port else None,
            f"Placewise {service} is running",
            executed=self._executed,
        )

    def __getitem__(self, name: str) -> ServiceProcess:
        return self.services[name]

    def __enter__(self) -> Self:
        migrate(self.catalog)
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        if self._supervisor.is_alive():
            self._supervisor.join()
        self.kill_all()
        self.catalog.close()

    def start(self, *names: str) -> None:
        """Start the named services, or all, and wait until they are ready."""
        chosen = [self.services[name] for name in names] or list(self.services.values())
        for service in chosen:
            service.start()
        for service in chosen:
            service.wait_until_ready()
        if not self._supervisor.is_alive():
            self._supervisor.start()

    def kill_all(self) -> None:
        """Send SIGKILL to every service."""
        for service in self.services.values():
            service.kill()

    def _supervise(self) -> None:
        while not self._stop.wait(POLL_SECONDS):
            for service in self.services.values():
                if service.restart_if_exited():
                    self.crashed.append(service.name)

    def cpu_seconds(self) -> dict[str, float]:
        """Return the CPU time used so far by each running service and each server."""
        services = {n: each.cpu_seconds() for n, each in self.services.items() if each.running}
        return services | {n: each.cpu_seconds() for n, each in self.servers.processes.items()}

    def logs(self) -> str:
        return "\n".join(f"--- {name}\n{one.log()}" for name, one in self.services.items())


@contextlib.contextmanager
def open_fleet(servers: Servers | None = None, **options: Any) -> Iterator[Fleet]:
    """Context manager of a fleet in a temporary folder, by default on servers of its own."""
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        servers = servers or stack.enter_context(start_servers())
        yield stack.enter_context(Fleet(folder, servers, **options))
