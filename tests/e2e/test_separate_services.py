"""Gateway, extractors, search and steward in processes of their own, on real servers."""

from __future__ import annotations

import re
import signal
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import httpx2
import psutil
import pytest

from tests.support.photos import photo_bytes
from tests.support.processes import PLACEWISE, Process, start
from tests.support.server import SERVICES_KEY, environment, run_command
from tests.support.servers import PostgresServer, RedisServer, start_redis
from tests.support.waiting import wait_until

SECONDS = 90.0
CRASHING = Path(__file__).with_name("crashing_placewise.py")


class Deployment:
    """Starts `placewise NAME` processes that share a catalog, a Redis and a folder of objects."""

    def __init__(self, root: Path, database_url: str, redis_url: str) -> None:
        self.root = root
        self.home = root / "home"
        self.settings = {
            "database_url": database_url,
            "redis_url": redis_url,
            "lease_seconds": 5,
            "search_urls": "",
            "admin_key": SERVICES_KEY,
        }
        self._processes: list[Process] = []

    def migrate(self) -> None:
        env = environment(self.home, **self.settings)
        migrated = run_command("storage", "migrate", env=env, cwd=self.root)
        assert migrated.returncode == 0, migrated.stderr

    def start(self, service: str, crashing: str | None = None, **settings: Any) -> Process:
        """Start the service; SIGRTMIN crashes its thread `crashing`."""
        log = self.root / f"{service}-{len(self._processes)}.log"
        program = [PLACEWISE] if crashing is None else [CRASHING, crashing]
        with log.open("wb") as out:
            env = environment(self.home, **{**self.settings, **settings})
            process = start([*program, service], env=env, cwd=self.root, stdout=out, stderr=out)
        self._processes.append(process)
        return process

    def client(self, number: int) -> httpx2.Client:
        """Of the gateway that was started as the `number`th process, with its key."""
        headers = {"Authorization": f"Bearer {SERVICES_KEY}"}
        return httpx2.Client(base_url=self.address("gateway", number), headers=headers, timeout=60)

    def address(self, service: str, number: int) -> str:
        """Where the process started as the `number`th says that it serves."""
        return self.announced(service, number, r"(?:serves|on) (http://127\.0\.0\.1:\d+)")

    def announced(self, service: str, number: int, pattern: str) -> str:
        """The group of `pattern` in what that process says once it is ready."""
        log = self.root / f"{service}-{number}.log"

        def find() -> re.Match[str] | None:
            ended = self._processes[number].poll() is not None
            found = re.search(pattern, log.read_text())
            assert found or not ended, log.read_text()
            return found

        return wait_until(find, SECONDS)[1]  # type: ignore[index]  # it is a match by now

    def logs(self) -> str:
        return "\n".join(
            f"{log.name}: {log.read_text()[-2000:]}" for log in self.root.glob("*.log")
        )

    def close(self) -> None:
        for process in self._processes:
            if process.poll() is None:
                process.kill()
            process.wait()


@pytest.fixture
def deployment(tmp_path: Path, postgres: PostgresServer) -> Iterator[Deployment]:
    with start_redis(own=True) as redis:
        made = Deployment(tmp_path, postgres.new_database(), redis.url)
        try:
            made.migrate()
            yield made
        finally:
            made.close()


def test_services_in_processes_of_their_own_do_what_the_embedded_one_does(
    deployment: Deployment,
) -> None:
    deployment.start("search")
    deployment.start("search")
    urls = [deployment.address("search", number) for number in (0, 1)]
    deployment.settings["search_urls"] = ",".join(urls)
    deployment.start("gateway")
    extractors = [deployment.start("extractor") for _ in range(2)]
    stewards = [deployment.start("steward") for _ in range(2)]
    with deployment.client(2) as client:
        wait_until(lambda: client.get("/readyz").is_success, SECONDS)

        def put(number: int) -> dict[str, Any]:
            answer = client.post(
                "/api/v1/upload",
                files={"file": (f"{number}.jpg", photo_bytes(number))},
                data={"latitude": str(45 + number / 100), "longitude": "7"},
            )
            assert answer.status_code == 202, answer.text
            found: dict[str, Any] = answer.json()
            return found

        def ended(job_id: str) -> bool:
            job = client.get(f"/api/v1/jobs/{job_id}", params={"wait": 20}).json()
            assert job["state"] != "failed", job
            return bool(job["state"] == "succeeded")

        def first_match(photo: bytes) -> Any:
            answer = client.post(
                "/api/v1/similarity",
                params={"top_k": 1},
                files={"file": ("query.jpg", photo)},
                headers={"Prefer": "wait=30"},
            )
            assert answer.status_code == 200, answer.text
            body = answer.json()
            assert body["missing"] == []
            return body["similar_images"][0]["original_filename"]

        for upload in [put(number) for number in range(12)]:
            wait_until(partial(ended, upload["job_id"]), SECONDS)
        assert first_match(photo_bytes(5)) == "5.jpg"

        # One extractor and one steward die in the middle of work; the others go on.
        uploads = [put(number) for number in range(12, 44)]
        extractors[0].send_signal(signal.SIGKILL)
        stewards[0].send_signal(signal.SIGKILL)
        for upload in uploads:
            wait_until(partial(ended, upload["job_id"]), SECONDS)
        assert first_match(photo_bytes(40)) == "40.jpg"
        stats = client.get("/api/v1/database/stats").json()
        assert (stats["total_images"], stats["searchable_images"]) == (44, 44)

        evaluation = client.post("/api/v1/evaluations", json={"sample": 30}).json()
        wait_until(partial(ended, evaluation["job_id"]), SECONDS)
        assert client.get("/api/v1/evaluations").json()["evaluations"]

        for process in (extractors[1], stewards[1]):
            process.terminate()
        assert [p.wait(timeout=30) for p in (extractors[1], stewards[1])] == [0, 0]
    assert "Traceback" not in deployment.logs()


@pytest.mark.parametrize(
    ("service", "threads"),
    [
        ("gateway", ["heartbeat", "wakeups", "search-workers"]),
        ("search", ["search sync", "search sync of building generations", "heartbeat"]),
        ("extractor", ["heartbeat", "wakeups"]),
        (
            "steward",
            ["wakeups", "steward", "collect_orphans", "evaluator", "batches", "webhooks"],
        ),
        ("serve", ["search", "extractor", "extractor process", "steward", "collect_orphans"]),
    ],
)
def test_a_thread_that_crashes_ends_its_process(
    service: str, threads: list[str], deployment: Deployment
) -> None:
    deployment.settings |= {"search_urls": "http://127.0.0.1:9"}
    if service == "serve":
        deployment.settings |= {"search_urls": "", "database_url": ""}
    processes = [
        deployment.start(service, crashing=name, placewise_home=deployment.root / name)
        for name in threads
    ]
    for number, process in enumerate(processes):
        deployment.announced(service, number, r"Placewise (.*(serves|listens|is running))")
        process.send_signal(signal.SIGRTMIN)
        if threads[number] == "extractor" and service == "serve":
            (extractor,) = psutil.Process(process.pid).children()
            extractor.send_signal(signal.SIGRTMIN)
    for number, (name, process) in enumerate(zip(threads, processes, strict=True)):
        log = deployment.root / f"{service}-{number}.log"
        assert process.wait(timeout=SECONDS) == 1, f"{name}: {log.read_text()[-3000:]}"
        assert f"RuntimeError: {name} was asked to crash" in log.read_text()
        assert log.read_text().splitlines()[-1].startswith("thread_crashed: ")


@pytest.mark.parametrize(
    ("service", "settings", "code"),
    [
        ("serve", {"search_urls": "http://127.0.0.1:9"}, "separate_services"),
        ("gateway", {"redis_url": ""}, "redis_missing"),
        ("gateway", {}, "search_missing"),
        ("steward", {}, "search_missing"),
        ("extractor", {"redis_url": ""}, "redis_missing"),
        (
            "gateway",
            {"search_urls": "http://127.0.0.1:9"},
            "admin_key_missing",
        ),
    ],
)
def test_what_a_service_lacks_is_one_line(
    service: str, settings: dict[str, str], code: str, tmp_path: Path, redis: RedisServer
) -> None:
    env = environment(tmp_path / "home", **{"redis_url": redis.url, **settings})
    ended = run_command(service, env=env, cwd=tmp_path)
    assert ended.returncode == 1
    assert ended.stderr.splitlines()[-1].startswith(f"{code}: ")
