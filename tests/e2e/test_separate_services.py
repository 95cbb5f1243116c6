"""Services in processes of their own: what ends them, and what they lack."""

from __future__ import annotations

import contextlib
import re
import signal
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import psutil
import pytest

from tests.support.processes import Process, start
from tests.support.server import SERVICES_KEY, environment, run_command
from tests.support.servers import PostgresServer, RedisServer, start_redis
from tests.support.waiting import wait_until

SECONDS = 90.0
CRASHING = Path(__file__).with_name("crashing_placewise.py")
READY = re.compile(r"Placewise (.*(serves|listens|is running))")


@pytest.fixture
def services(tmp_path: Path, postgres: PostgresServer) -> Iterator[dict[str, Any]]:
    """The settings of services on one catalog and one Redis."""
    with start_redis(own=True) as redis:
        settings = {
            "database_url": postgres.new_database(),
            "redis_url": redis.url,
            "search_urls": "http://127.0.0.1:9",
            "admin_key": SERVICES_KEY,
        }
        env = environment(tmp_path / "home", **settings)
        migrated = run_command("storage", "migrate", env=env, cwd=tmp_path)
        assert migrated.returncode == 0, migrated.stderr
        yield settings


def has_started(process: Process, log: Path) -> bool:
    return process.poll() is not None or READY.search(log.read_text()) is not None


@pytest.mark.parametrize(
    ("service", "threads"),
    [
        ("gateway", ["heartbeat", "wakeups", "search-workers"]),
        ("search", ["search sync", "search sync of building generations", "heartbeat"]),
        ("extractor", ["heartbeat", "wakeups"]),
        ("steward", ["wakeups", "steward", "collect_orphans", "evaluator", "batches", "webhooks"]),
        ("serve", ["search", "extractor", "extractor process", "steward", "collect_orphans"]),
    ],
)
def test_a_thread_that_crashes_ends_its_process(
    service: str, threads: list[str], services: dict[str, Any], tmp_path: Path
) -> None:
    """SIGRTMIN crashes the thread that the program is given."""
    if service == "serve":
        services |= {"search_urls": "", "database_url": ""}
    processes: dict[str, Process] = {}
    logs = {name: tmp_path / f"{name}.log" for name in threads}
    with contextlib.ExitStack() as started:
        for name in threads:
            env = environment(tmp_path / name, **services)
            with logs[name].open("wb") as log:
                processes[name] = start(
                    [CRASHING, name, service], env=env, cwd=tmp_path, stdout=log, stderr=log
                )
            started.callback(processes[name].wait)
            started.callback(processes[name].kill)
        for name, process in processes.items():
            wait_until(partial(has_started, process, logs[name]))
            process.send_signal(signal.SIGRTMIN)
            if name == "extractor" and service == "serve":
                (extractor,) = psutil.Process(process.pid).children()
                extractor.send_signal(signal.SIGRTMIN)
        for name, process in processes.items():
            assert process.wait(timeout=SECONDS) == 1, f"{name}: {logs[name].read_text()[-3000:]}"
            assert f"RuntimeError: {name} was asked to crash" in logs[name].read_text()
            assert logs[name].read_text().splitlines()[-1].startswith("thread_crashed: ")


@pytest.mark.parametrize(
    ("service", "settings", "code"),
    [
        ("serve", {"search_urls": "http://127.0.0.1:9"}, "separate_services"),
        ("gateway", {"redis_url": ""}, "redis_missing"),
        ("gateway", {}, "search_missing"),
        ("steward", {}, "search_missing"),
        ("extractor", {"redis_url": ""}, "redis_missing"),
        ("gateway", {"search_urls": "http://127.0.0.1:9"}, "admin_key_missing"),
    ],
)
def test_what_a_service_lacks_is_one_line(
    service: str, settings: dict[str, str], code: str, tmp_path: Path, redis: RedisServer
) -> None:
    env = environment(tmp_path / "home", **{"redis_url": redis.url, **settings})
    ended = run_command(service, env=env, cwd=tmp_path)
    assert ended.returncode == 1
    assert ended.stderr.splitlines()[-1].startswith(f"{code}: ")
