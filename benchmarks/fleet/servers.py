"""The real servers that a fleet runs on: PostgreSQL, Redis and an S3 store, nobody else's."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from urllib.parse import urlsplit

from sqlalchemy.engine import make_url

from benchmarks.fleet.proxy import FaultProxy
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
    """Started, and each may be killed. Services reach them through proxies, which can fail."""

    postgres: PostgresServer
    redis: RedisServer
    s3: S3Server
    postgres_proxy: FaultProxy
    redis_proxy: FaultProxy
    s3_proxy: FaultProxy

    @property
    def processes(self) -> dict[str, Handle]:
        """The servers themselves by name."""
        found = {
            "PostgreSQL": self.postgres.process,
            "Redis": self.redis.process,
            "the S3 store": self.s3.process,
        }
        return {name: process for name, process in found.items() if process is not None}

    def proxied_database(self, url: str) -> str:
        """The URL of a database of `postgres` as the services see it."""
        proxied = make_url(url).set(port=self.postgres_proxy.port)
        return proxied.render_as_string(hide_password=False)

    @property
    def proxied_redis_url(self) -> str:
        """Redis as the services see it."""
        proxied = make_url(self.redis.url).set(port=self.redis_proxy.port)
        return proxied.render_as_string(hide_password=False)

    @property
    def proxied_s3(self) -> S3Server:
        """The store as the services see it."""
        return S3Server(
            f"127.0.0.1:{self.s3_proxy.port}",
            self.s3.access_key,
            self.s3.secret_key,
            self.s3.secure,
            self.s3.process,
        )


@contextlib.contextmanager
def start_servers() -> Iterator[Servers]:
    """All three, until the block ends."""
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
