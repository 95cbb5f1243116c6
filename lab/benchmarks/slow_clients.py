"""Latency of `GET /maps` and of uploads under slow-client attacks.

    placewise bench slow-clients [--seconds 30] [--idle 1100] [--bodies 32] [--streams 500]

Three attacks, one after the other and then at once: idle connections, uploads of one byte a second,
and event streams. Server and clients run on this machine. The idle connections come from the
address of the timed calls, the others from addresses of their own (127.0.0.0/8). All are reopened
when the server closes them. Reported for each attack: p50, p95 and maximum of both calls, failed
calls, and the growth of the server's log.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import multiprocessing
import random
import resource
import tempfile
import time
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass, field
from http.client import HTTPConnection, HTTPException
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from lab.benchmarks.fleet.load_generator import BOUNDARY, CONTENT_TYPE, make_jpegs, multipart_form
from lab.benchmarks.fleet.service import start_embedded_server
from lab.benchmarks.report import LatencySummary, Report
from placewise.client import Client
from shared.errors import Unavailable

if TYPE_CHECKING:
    from rich.progress import Progress

MAX_P95_RATIO = 5.0  # maximum p95 relative to the p95 without an attack
MAX_LOG_BYTES_PER_MINUTE = 1_000_000
START_SECONDS = 60.0
SETTLE_SECONDS = 10.0  # time for the attack to open its connections
CALL_SECONDS = 30.0  # timeout of a call
REOPEN_SECONDS = 5.0  # delay before a closed connection is reopened
WATCHED_JOBS = 50
CALLERS = 5  # keys and addresses of the event streams, whose number is limited per key
OPEN_FILES = 1024
BODY_BYTES = 5_000_000
EXTRACTOR = "test-tiny-vlad"  # its jobs wait for a vocabulary, so their event streams stay open
SLOW_ADDRESS, STREAM_ADDRESS = "127.0.1.1", "127.0.2.{}"  # of the clients
ADDRESS = "127.0.0.1"  # source address of the idle connections and of the timed calls


@dataclass(slots=True)
class Calls:
    """Timings and failures of one phase."""

    maps: list[float] = field(default_factory=list)
    uploads: list[float] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    log_bytes_per_minute: float = 0.0


@dataclass(frozen=True, slots=True)
class _Attack:
    """An attack on the server, which runs in a process of its own."""

    port: int
    idle: int
    bodies: int
    streams: int
    body_key: str
    stream_keys: tuple[str, ...]
    jobs: tuple[str, ...]


def measure(progress: Progress, *, seconds: float, idle: int, bodies: int, streams: int) -> Report:
    """Run each phase for `seconds`.

    The server may open 1,024 files and has default settings except for its extractor.
    """
    report = Report(f"While {idle:,} clients are idle, {bodies} bodies slow, {streams} watch jobs")
    photo = make_jpegs(1, (640, 480), 60_000)[0]
    phases = {
        "no attack": (0, 0, 0),
        "idle connections": (idle, 0, 0),
        "slow bodies": (0, bodies, 0),
        "event streams": (0, 0, streams),
        "all at once": (idle, bodies, streams),
    }
    found: dict[str, Calls] = {}
    with (
        tempfile.TemporaryDirectory() as folder,
        start_embedded_server(
            Path(folder),
            max_open_files=OPEN_FILES,
            HOST=ADDRESS,
            ADMIN_KEY="the-admin-key-of-the-measurement",
            EXTRACTOR=EXTRACTOR,
            ALLOW_TEST_EXTRACTORS="true",
        ) as server,
    ):
        log = Path(folder, "server.log")
        port = urlsplit(server.url).port
        assert port is not None
        with Client(server.url, key=server.key, patience_seconds=START_SECONDS) as client:
            ours, slow, *watching = (
                client.create_key(f"{number}", ["read", "write"]).key
                for number in range(2 + CALLERS)
            )
        jobs = tuple(_upload(port, ours, photo) for _ in range(WATCHED_JOBS))
        bar = progress.add_task("phases", total=len(phases))
        for name, numbers in phases.items():
            with _under(_Attack(port, *numbers, slow, tuple(watching), jobs)):
                found[name] = _timed(port, ours, photo, seconds, log)
            progress.advance(bar)
    baseline = found["no attack"]
    for name, calls in found.items():
        for what, measured, without_attack in (
            ("GET /maps", calls.maps, baseline.maps),
            ("upload", calls.uploads, baseline.uploads),
        ):
            limit_ms = 1000 * MAX_P95_RATIO * LatencySummary.of(without_attack).p95
            report.add_latency(
                f"{name}: {what}",
                measured,
                p95_at_most_ms=None if calls is baseline else limit_ms,
            )
        report.add(f"{name}: failed calls", len(calls.failed), at_most=0)
        report.add(
            f"{name}: log",
            calls.log_bytes_per_minute / 1000,
            "kB a minute",
            at_most=MAX_LOG_BYTES_PER_MINUTE / 1000,
        )
    report.details = {
        "failed": {name: calls.failed[:10] for name, calls in found.items()},
        "calls": {name: len(calls.maps) + len(calls.uploads) for name, calls in found.items()},
    }
    return report


def _timed(port: int, key: str, photo: bytes, seconds: float, log: Path) -> Calls:
    """Make both calls in turn, each over a connection of its own."""
    calls = Calls()
    size, started_at = log.stat().st_size, time.monotonic()
    while (now := time.monotonic()) < started_at + seconds or not calls.uploads:
        timings = calls.maps if len(calls.maps) <= len(calls.uploads) else calls.uploads
        try:
            if timings is calls.maps:
                _call(port, key, "GET", "/api/v1/maps")
            else:
                _upload(port, key, photo)
        except (OSError, HTTPException, Unavailable) as error:
            calls.failed.append(repr(error))
        timings.append(time.monotonic() - now)
    calls.log_bytes_per_minute = (log.stat().st_size - size) / (time.monotonic() - started_at) * 60
    return calls


def _upload(port: int, key: str, photo: bytes) -> str:
    """Upload and return the id of the photo's job."""
    answer = _call(port, key, "POST", "/api/v1/upload", multipart_form(photo), **CONTENT_TYPE)
    return str(answer["job_id"])


def _call(
    port: int, key: str, method: str, path: str, body: bytes | None = None, **headers: str
) -> dict[str, str]:
    connection = HTTPConnection(ADDRESS, port, timeout=CALL_SECONDS)
    with contextlib.closing(connection):
        connection.request(method, path, body, {"Authorization": f"Bearer {key}", **headers})
        answer = connection.getresponse()
        data = answer.read()
        if answer.status >= 300:
            raise Unavailable("refused", f"{method} {path}: {answer.status} {data!r}")
        found: dict[str, str] = json.loads(data)
        return found


@contextlib.contextmanager
def _under(attack: _Attack) -> Iterator[None]:
    """Run the attack in a process of its own, started SETTLE_SECONDS before the block."""
    context = multiprocessing.get_context("spawn")
    started = context.Event()
    process = context.Process(target=_attack, args=(attack, started))
    process.start()
    try:
        if not started.wait(START_SECONDS):
            raise Unavailable("attack_not_begun", "The process of the slow clients did not start.")
        time.sleep(SETTLE_SECONDS)
        yield
    finally:
        process.kill()
        process.join()


def _attack(attack: _Attack, started: Event) -> None:
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    started.set()
    asyncio.run(_attack_together(attack))


async def _attack_together(attack: _Attack) -> None:
    clients: list[Callable[[], Awaitable[None]]] = []
    clients += [lambda: _hold(attack.port, ADDRESS, b"")] * attack.idle
    head = (
        b"POST /api/v1/upload HTTP/1.1\r\nHost: localhost\r\n"
        + f"Authorization: Bearer {attack.body_key}\r\n".encode()
        + f"Content-Type: multipart/form-data; boundary={BOUNDARY}\r\n".encode()
        + f"Content-Length: {BODY_BYTES}\r\n\r\n--{BOUNDARY}\r\n".encode()
    )
    clients += [lambda: _hold(attack.port, SLOW_ADDRESS, head, drips=True)] * attack.bodies
    for number in range(attack.streams):
        clients.append(_stream(attack, number))
    await asyncio.gather(*(_again(client) for client in clients))


def _stream(attack: _Attack, number: int) -> Callable[[], Awaitable[None]]:
    caller = number % CALLERS
    head = (
        f"GET /api/v1/jobs/{attack.jobs[number % len(attack.jobs)]}/events HTTP/1.1\r\n"
        f"Host: localhost\r\nAuthorization: Bearer {attack.stream_keys[caller]}\r\n\r\n"
    ).encode()
    return lambda: _hold(attack.port, STREAM_ADDRESS.format(caller + 1), head)


async def _again(client: Callable[[], Awaitable[None]]) -> None:
    while True:
        with contextlib.suppress(OSError):
            await client()
        await asyncio.sleep(REOPEN_SECONDS * random.uniform(0.5, 1.5))


async def _hold(port: int, address: str, head: bytes, *, drips: bool = False) -> None:
    """Wait until the server closes the connection."""
    reader, writer = await asyncio.open_connection(ADDRESS, port, local_addr=(address, 0))
    try:
        writer.write(head)
        while True:
            try:
                if not await asyncio.wait_for(reader.read(65536), 1.0 if drips else None):
                    return
            except TimeoutError:
                writer.write(b"-")
    finally:
        writer.close()
