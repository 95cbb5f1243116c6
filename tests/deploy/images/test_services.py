"""Placewise from its images, as the compose files start it. Each test continues the one above."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx2
import psycopg
import pytest
from redis import Redis
from redis.exceptions import RedisError
from sqlalchemy.engine import URL

from shared.jobs.wakeups import WakeupQueue
from tests.deploy.composition import EMBEDDED, SERVICES, make_env, services, variables
from tests.deploy.images.conftest import BuildImage
from tests.deploy.images.machine import Machine
from tests.support.photos import photo_bytes
from tests.support.servers import start_postgres

# Short, so that the jobs of a killed extractor are soon claimed again.
SETTINGS = "LEASE_SECONDS=10\n"
AT_WORK = ("search", "gateway", "extractor", "extractor-2", "steward", "flower")
PHOTOS = 24
SECONDS = 240.0  # for work of seconds
pytestmark = pytest.mark.timeout(1200)  # with the builds, on a busy machine

Json = dict[str, Any]


class Caller:
    """Calls the API that a service of the machine serves."""

    def __init__(self, machine: Machine, service: str, key: str) -> None:
        self._machine = machine
        self.client = httpx2.Client(
            base_url=machine.url(service), headers={"Authorization": f"Bearer {key}"}, timeout=60
        )

    def upload(self, number: int) -> str:
        """Its job."""
        answer = self.client.post(
            "/api/v1/upload",
            files={"file": (f"{number}.jpg", photo_bytes(number))},
            data={"latitude": str(45 + number / 1000), "longitude": "7"},
        )
        assert answer.status_code == 202, answer.text
        return str(answer.json()["job_id"])

    def job(self, job_id: str, **params: Any) -> Json:
        found: Json = self.client.get(f"/api/v1/jobs/{job_id}", params=params).json()
        return found

    def succeeded(self, job_id: str) -> None:
        """Wait until the job has succeeded."""

        def ended() -> Json | None:
            job = self.job(job_id, wait=5)
            return None if job["state"] in ("queued", "running") else job

        job = self.until(ended)
        assert job["state"] == "succeeded", job

    def search(self, number: int) -> Json:
        """The answer for a photo, of which the first match is that photo."""
        answer = self.client.post(
            "/api/v1/similarity",
            params={"top_k": 1},
            files={"file": ("query.jpg", photo_bytes(number))},
            headers={"Prefer": "wait=60"},
        )
        assert answer.status_code == 200, answer.text
        found: Json = answer.json()
        assert found["similar_images"][0]["original_filename"] == f"{number}.jpg"
        return found

    def until(self, what: Callable[[], Any]) -> Any:
        """What it returns once that is true, while every service runs."""
        deadline = time.monotonic() + SECONDS
        while not (found := what()):
            self._machine.check_running()
            assert time.monotonic() < deadline, f"it did not come to that in {SECONDS:g} s"
            time.sleep(0.2)
        return found


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("composition")
    (made / "placewise.env").write_text(SETTINGS)
    return made


@pytest.fixture(scope="module")
def values(folder: Path) -> dict[str, str]:
    return variables(make_env(folder))


@pytest.fixture(scope="module")
def machine(folder: Path, values: dict[str, str], image: BuildImage) -> Iterator[Machine]:
    read = services(SERVICES, folder, values)
    read |= {
        "extractor-2": read["extractor"],
        "placewise": services(EMBEDDED, folder, values)["placewise"],
    }
    with start_postgres(own=True) as postgres:
        make_database(postgres.admin, read["postgres"]["environment"])
        places = {"postgres:5432": f"127.0.0.1:{postgres.admin.port}"}
        made = Machine(folder / "machine", read, image, places)
        try:
            for server in ("redis", "objects"):
                made.start(server)
            made.wait_until_healthy("redis", "objects")
            for once in ("migrate", "create-bucket") * 2:  # again at each `docker compose up`
                assert made.run_once(once) == 0, made.log(once)
            for service in AT_WORK:
                made.start(service)
            made.wait_until_healthy(*AT_WORK)
            yield made
        finally:
            made.close()


def make_database(admin: URL, fields: dict[str, str]) -> None:
    """What the image of PostgreSQL does at its first start."""
    user, password, name = (fields[f"POSTGRES_{part}"] for part in ("USER", "PASSWORD", "DB"))
    url = admin.set(drivername="postgresql").render_as_string(hide_password=False)
    with psycopg.connect(url, autocommit=True) as connection:
        connection.execute(f"CREATE ROLE {user} LOGIN PASSWORD '{password}'")
        connection.execute(f"CREATE DATABASE {name} OWNER {user}")


@pytest.fixture(scope="module")
def api(machine: Machine, values: dict[str, str]) -> Iterator[Caller]:
    made = Caller(machine, "gateway", values["ADMIN_KEY"])
    with made.client:
        yield made


def test_api_servers_and_flower_require_their_passwords(machine: Machine) -> None:
    assert machine.run_once("create-bucket", S3_SECRET_KEY="another") == 1
    redis = f"redis://127.0.0.1:{machine.port('redis')}"
    with Redis.from_url(redis) as stranger, pytest.raises(RedisError):
        stranger.ping()
    assert httpx2.get(f"{machine.url('gateway')}/api/v1/maps").status_code == 401
    for path in ("/", "/workers", "/tasks", "/api/tasks", "/api/workers"):
        for wrong in (None, ("flower", "guessed")):
            assert httpx2.get(machine.url("flower") + path, auth=wrong).status_code == 401, path


def test_photo_is_described_and_found(api: Caller) -> None:
    for job in [api.upload(number) for number in range(PHOTOS)]:
        api.succeeded(job)
    answer = api.search(5)
    assert (answer["vocabulary"], answer["missing"]) == ("foreign", [])


def test_flower_shows_the_extractors_and_the_photos(
    machine: Machine, api: Caller, values: dict[str, str]
) -> None:
    key = ("flower", values["FLOWER_PASSWORD"])
    with httpx2.Client(base_url=machine.url("flower"), auth=key, timeout=60) as flower:

        def workers() -> Any:
            return flower.get("/workers", params={"json": "1"}).json()["data"]

        api.until(lambda: len(workers()) == 2)
        job = api.upload(PHOTOS)
        api.succeeded(job)

        def task() -> Json | None:
            shown = flower.get("/api/tasks").json().get(job)
            return shown if shown and shown["state"] == "SUCCESS" else None

        shown = api.until(task)
        assert shown["name"] == "placewise.index"
        assert f"{PHOTOS}.jpg" in shown["kwargs"]
        queues = flower.get("/api/queues/length").json()["active_queues"]
        assert {queue["name"] for queue in queues} == set(WakeupQueue)

        names = {worker["hostname"] for worker in workers()}
        api.until(lambda: set(flower.get("/api/workers", params={"refresh": "1"}).json()) == names)
        # What Flower shows can't be changed by it.
        for path in (f"/api/worker/shutdown/{next(iter(names))}", "/api/task/send-task/any"):
            assert flower.post(path).status_code == 403


def test_vocabulary_fit_ends_and_answers(api: Caller) -> None:
    """The steward queues the second description, and wakes the extractors for it."""
    started = api.client.post("/api/v1/vocabularies")
    assert started.status_code == 202, started.text
    api.succeeded(started.json()["job_id"])
    assert api.search(7)["vocabulary"] in ("own", "provisional")


def test_jobs_of_a_killed_extractor_are_taken_over(machine: Machine, api: Caller) -> None:
    machine.send_signal("extractor-2", signal.SIGSTOP)
    jobs = [api.upload(number) for number in range(100, 100 + PHOTOS)]

    def holds_jobs() -> bool:
        machine.send_signal("extractor", signal.SIGSTOP)
        if any(api.job(job)["state"] == "running" for job in jobs):
            return True
        machine.send_signal("extractor", signal.SIGCONT)
        return False

    api.until(holds_jobs)
    machine.kill("extractor")
    machine.send_signal("extractor-2", signal.SIGCONT)
    for job in jobs:
        api.succeeded(job)
    assert api.search(101)["missing"] == []


def test_jobs_of_a_stopped_extractor_go_back_and_idle_services_beat(
    machine: Machine, api: Caller
) -> None:
    jobs = [api.upload(number) for number in range(200, 200 + PHOTOS)]
    assert machine.stop("extractor-2") == 0, machine.log("extractor-2")
    machine.start("extractor")
    for job in jobs:
        api.succeeded(job)
    for service in ("extractor", "steward"):  # they beat while there is nothing to do
        (machine.folder(service) / "heartbeat").unlink(missing_ok=True)
    machine.wait_until_healthy("extractor", "steward")
    assert api.client.get("/api/v1/health").json()["status"] == "healthy"


def test_embedded_image_describes_and_finds_a_photo(
    machine: Machine, values: dict[str, str]
) -> None:
    machine.start("placewise")
    machine.wait_until_healthy("placewise")
    api = Caller(machine, "placewise", values["ADMIN_KEY"])
    with api.client:
        for job in [api.upload(number) for number in range(3)]:
            api.succeeded(job)
        api.search(1)
    assert machine.stop("placewise") == 0, machine.log("placewise")


def test_services_notice_what_is_missing_and_end_in_time(machine: Machine) -> None:
    assert machine.stop("flower") == 0, machine.log("flower")  # without Redis, it takes longer
    machine.stop("redis")
    assert not machine.is_healthy("redis")
    for service in ("gateway", "extractor", "search", "steward"):
        assert machine.stop(service) == 0, machine.log(service)
        assert "Traceback" not in machine.log(service)
