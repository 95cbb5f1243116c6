"""Runs the services of a Placewise on dedicated servers: PostgreSQL, Redis and an S3 store."""

from __future__ import annotations

import contextlib
import itertools
import tempfile
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self
from urllib.parse import urlsplit

from sqlalchemy.engine import make_url

from lab.benchmarks.fleet.fault_injection import FaultProxy
from lab.benchmarks.fleet.service import ServiceProcess
from shared.catalog.database.schema import migrate
from shared.catalog.database.session import Catalog
from shared.storage import ObjectStore
from shared.storage.s3 import S3Store
from tests.support.processes import PLACEWISE
from tests.support.server import SERVICES_KEY, environment
from tests.support.servers import (
    PostgresServer,
    RedisServer,
    S3Server,
    start_postgres,
    start_redis,
    start_s3,
)
from tests.support.servers.daemon import free_ports
from tests.support.servers.handle import Handle


@dataclass(frozen=True, slots=True)
class Servers:
    """The started servers, each of which can be killed. Services connect through fault proxies."""

    postgres: PostgresServer
    redis: RedisServer
    s3: S3Server
    postgres_proxy: FaultProxy
    redis_proxy: FaultProxy
    s3_proxy: FaultProxy

    @property
    def processes(self) -> dict[str, Handle]:
        """Server processes by name."""
        found = {
            "PostgreSQL": self.postgres.process,
            "Redis": self.redis.process,
            "the S3 store": self.s3.process,
        }
        return {name: process for name, process in found.items() if process is not None}

    def proxied_database(self, url: str) -> str:
        """Return the URL of a PostgreSQL database through its proxy."""
        proxied = make_url(url).set(port=self.postgres_proxy.port)
        return proxied.render_as_string(hide_password=False)

    @property
    def proxied_redis_url(self) -> str:
        """URL of Redis through its proxy."""
        proxied = make_url(self.redis.url).set(port=self.redis_proxy.port)
        return proxied.render_as_string(hide_password=False)

    @property
    def proxied_s3(self) -> S3Server:
        """Settings of the S3 store through its proxy."""
        return S3Server(
            f"127.0.0.1:{self.s3_proxy.port}",
            self.s3.access_key,
            self.s3.secret_key,
            self.s3.secure,
            self.s3.process,
        )


@contextlib.contextmanager
def start_servers() -> Iterator[Servers]:
    """Context manager that starts all three servers."""
    with (
        start_postgres(own=True) as postgres,
        start_redis(own=True) as redis,
        start_s3(own=True) as s3,
        _proxy(postgres.admin.port) as postgres_proxy,
        _proxy(urlsplit(redis.url).port) as redis_proxy,
        _proxy(urlsplit(f"//{s3.endpoint}").port) as s3_proxy,
    ):
        yield Servers(postgres, redis, s3, postgres_proxy, redis_proxy, s3_proxy)


def _proxy(target: int | None) -> FaultProxy:
    assert target is not None, "servers of our own have a port"
    return FaultProxy(free_ports(1)[0], target)


S3_TIMEOUT_SECONDS = 2.0  # so that a silent store is noticed within a fault
POLL_SECONDS = 0.2


class Fleet:
    """Services by name: `gateway-0..`, `extractor-0..`, `search-SHARD-REPLICA`, `steward-0..`.

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
        shards: int = 1,
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
        self.servers = servers
        bucket = servers.s3.new_bucket()
        database_url = servers.postgres.new_database()
        # Ours go past the proxies.
        self.catalog = Catalog(database_url)
        self.store: ObjectStore = S3Store(bucket)
        redis_url, s3 = servers.redis.url, servers.s3
        if through_proxies:
            database_url = servers.proxied_database(database_url)
            redis_url, s3 = servers.proxied_redis_url, servers.proxied_s3
        ports = iter(free_ports(gateways + shards * replicas))
        searches = {
            (shard, replica): next(ports)
            for shard, replica in itertools.product(range(shards), range(replicas))
        }
        self.search_urls = [f"http://127.0.0.1:{port}" for port in searches.values()]
        self._folder = folder
        self._settings = {
            "database_url": database_url,
            "redis_url": redis_url,
            "admin_key": SERVICES_KEY,
            "search_urls": ",".join(self.search_urls),
            **s3.variables(bucket.name),
            "s3_timeout_seconds": S3_TIMEOUT_SECONDS,
            **settings,
        }
        self.lease_seconds = float(settings.get("lease_seconds", 60.0))
        self.services: dict[str, ServiceProcess] = {}
        for (shard, replica), port in searches.items():
            self._add(f"search-{shard}-{replica}", port, search_shard=f"{shard}/{shards}")
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
        for service in self.services.values():
            service.kill()
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

    def _supervise(self) -> None:
        while not self._stop.wait(POLL_SECONDS):
            for service in self.services.values():
                if service.restart_if_exited():
                    self.crashed.append(service.name)

    @contextlib.contextmanager
    def without(self, name: str) -> Iterator[None]:
        """Context manager during which a service is killed; it is started again on exit."""
        self[name].kill()
        try:
            yield
        finally:
            self.start(name)

    def cpu_seconds(self) -> dict[str, float]:
        """Return the CPU time used so far by each running service."""
        return {
            name: service.cpu_seconds()
            for name, service in self.services.items()
            if service.running
        }

    def server_cpu_seconds(self) -> dict[str, float]:
        """Return the CPU time used so far by each server."""
        return {name: one.cpu_seconds() for name, one in self.servers.processes.items()}

    def logs(self) -> str:
        return "\n".join(f"--- {name}\n{one.log()}" for name, one in self.services.items())


@contextlib.contextmanager
def open_fleet(servers: Servers | None = None, **options: Any) -> Iterator[Fleet]:
    """Context manager of a fleet in a temporary folder, by default on servers of its own."""
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        servers = servers or stack.enter_context(start_servers())
        yield stack.enter_context(Fleet(folder, servers, **options))
