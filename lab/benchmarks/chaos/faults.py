"""Faults of the fault-injection suite. Each is a context manager inside which a component fails."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass

from redis import Redis

from lab.benchmarks.fleet import Fleet
from lab.benchmarks.fleet.fault_injection import MessageDuplicator, ProxyMode
from tests.support.servers.handle import Handle

# Services whose clock is wrong during the whole run, by so many seconds. S3 servers reject what is
# signed with a clock that is off by more than 900.
CLOCK_OFFSETS_SECONDS = {
    "gateway-1": 600,
    "extractor-1": 600,
    "extractor-2": -600,
    "search-1-0": -600,
    "steward-0": 600,
}


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault of the suite.

    `broken(fleet, seconds)` is a context manager that breaks a component on entry and repairs it on
    exit. Faults that have a duration last `seconds`.
    """

    name: str
    inject: Callable[[Fleet, float], AbstractContextManager[None]]


def all_faults() -> list[Fault]:
    """Return all faults in the order of the documentation; a run shuffles them."""
    return [
        *(Fault(f"kill -9 of {name}", _kill_service(name)) for name in _ONE_SERVICE_OF_EACH),
        Fault("kill -9 of every service at once", _kill_all_services),
        Fault("an extractor stands still beyond its lease", _pause_service("extractor-0")),
        Fault("a search worker stands still", _pause_service("search-0-0")),
        Fault("FLUSHALL", _flush_redis),
        Fault("Redis stopped", _stop_server(lambda fleet: fleet.servers.redis.process)),
        Fault("every message doubled", _duplicate_messages),
        Fault("PostgreSQL killed and started", _restart_postgres),
        Fault("PostgreSQL stopped", _stop_server(lambda fleet: fleet.servers.postgres.process)),
        Fault("the S3 store killed", _stop_server(lambda fleet: fleet.servers.s3.process)),
        Fault("the S3 store full (507)", _break_connections("the S3 store", ProxyMode.FULL)),
        *(
            Fault(f"connections to {server} {mode.name.lower()}", _break_connections(server, mode))
            for server in ("PostgreSQL", "Redis", "the S3 store")
            for mode in (ProxyMode.REFUSED, ProxyMode.CUT, ProxyMode.SLOW)
        ),
    ]


_ONE_SERVICE_OF_EACH = ("gateway-0", "extractor-0", "search-0-0", "search-1-0", "steward-0")
_FaultContext = Callable[[Fleet, float], AbstractContextManager[None]]


def _kill_service(name: str) -> _FaultContext:
    @contextlib.contextmanager
    def broken(fleet: Fleet, _seconds: float) -> Iterator[None]:
        with fleet.without(name):
            yield

    return broken


@contextlib.contextmanager
def _kill_all_services(fleet: Fleet, _seconds: float) -> Iterator[None]:
    for service in fleet.services.values():
        service.kill()
    yield
    fleet.start()


def _pause_service(name: str) -> _FaultContext:
    @contextlib.contextmanager
    def broken(fleet: Fleet, _seconds: float) -> Iterator[None]:
        fleet[name].pause()
        try:
            yield
            time.sleep(2 * fleet.lease_seconds)
        finally:
            fleet[name].resume()

    return broken


@contextlib.contextmanager
def _flush_redis(fleet: Fleet, _seconds: float) -> Iterator[None]:
    with Redis.from_url(fleet.servers.redis.url) as client:
        client.flushall()
        yield
        client.flushall()


@contextlib.contextmanager
def _duplicate_messages(fleet: Fleet, seconds: float) -> Iterator[None]:
    with MessageDuplicator(fleet.servers.redis.url).duplicating():
        yield
        time.sleep(seconds)


def _stop_server(choose: Callable[[Fleet], Handle | None]) -> _FaultContext:
    @contextlib.contextmanager
    def broken(fleet: Fleet, seconds: float) -> Iterator[None]:
        server = choose(fleet)
        assert server is not None, "a server of its own was started"
        server.kill()
        try:
            yield
            time.sleep(seconds)
        finally:
            server.start()

    return broken


@contextlib.contextmanager
def _restart_postgres(fleet: Fleet, _seconds: float) -> Iterator[None]:
    server = fleet.servers.postgres.process
    assert server is not None
    server.kill()
    server.start()
    yield


def _break_connections(server: str, mode: ProxyMode) -> _FaultContext:
    @contextlib.contextmanager
    def broken(fleet: Fleet, seconds: float) -> Iterator[None]:
        servers = fleet.servers
        proxy = {
            "PostgreSQL": servers.postgres_proxy,
            "Redis": servers.redis_proxy,
            "the S3 store": servers.s3_proxy,
        }[server]
        with proxy.in_mode(mode):
            yield
            time.sleep(seconds)

    return broken
