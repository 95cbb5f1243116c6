"""The services of docker-compose.yml at work, each by its own command, variables and check."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx2
import psycopg
import pytest
from redis import Redis
from redis.exceptions import RedisError
from sqlalchemy.engine import URL

from tests.deploy.composition import SERVICES, make_env, services, variables
from tests.deploy.machine import Machine
from tests.support.photos import photo_bytes
from tests.support.servers import PostgresServer, start_postgres

SETTINGS = "EXTRACTOR=test-tiny-avg\nALLOW_TEST_EXTRACTORS=true\nDECODE_PROCESSES=1\n"
AT_WORK = ("search-0", "search-1", "gateway", "extractor", "steward")


@pytest.fixture
def postgres_of_compose(tmp_path: Path) -> Iterator[PostgresServer]:
    with start_postgres(own=True) as server:
        yield server


@pytest.fixture
def values(tmp_path: Path) -> dict[str, str]:
    (tmp_path / "placewise.env").write_text(SETTINGS)
    return variables(make_env(tmp_path))


@pytest.fixture
def machine(
    tmp_path: Path, postgres_of_compose: PostgresServer, values: dict[str, str]
) -> Iterator[Machine]:
    admin = postgres_of_compose.admin
    read = services(SERVICES, tmp_path, values)
    make_database(admin, read["postgres"]["environment"])
    made = Machine(tmp_path / "machine", read, {"postgres:5432": f"127.0.0.1:{admin.port}"})
    try:
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


def test_compose_file_makes_a_placewise_that_works_and_ends_in_time(
    machine: Machine, values: dict[str, str]
) -> None:
    for server in ("redis", "objects"):
        machine.start(server)
    machine.wait_until_healthy("redis", "objects")
    for once in ("migrate", "create-bucket") * 2:  # again at each `docker compose up`
        assert machine.run_once(once) == 0, machine.log(once)

    # Passwords are required.
    assert machine.run_once("create-bucket", S3_SECRET_KEY="another") == 1
    redis = f"redis://127.0.0.1:{machine.port('redis')}"
    with Redis.from_url(redis) as stranger, pytest.raises(RedisError):
        stranger.ping()

    for service in AT_WORK:
        machine.start(service)
    machine.wait_until_healthy(*AT_WORK)
    for service in ("extractor", "steward"):  # they beat while there is nothing to do
        (machine.folder(service) / "heartbeat").unlink()
    machine.wait_until_healthy("extractor", "steward")
    key = {"Authorization": f"Bearer {values['ADMIN_KEY']}"}
    with httpx2.Client(base_url=machine.url("gateway"), headers=key, timeout=60) as client:
        assert httpx2.get(f"{machine.url('gateway')}/api/v1/maps").status_code == 401
        uploaded = client.post(
            "/api/v1/upload",
            files={"file": ("a.jpg", photo_bytes(1))},
            data={"latitude": "45", "longitude": "7"},
        )
        assert uploaded.status_code == 202, uploaded.text
        assert ended(client, uploaded.json()["job_id"])["state"] == "succeeded"
        found = client.post(
            "/api/v1/similarity",
            params={"top_k": 1},
            files={"file": ("query.jpg", photo_bytes(1))},
            headers={"Prefer": "wait=30"},
        )
        assert found.status_code == 200, found.text
        assert found.json()["missing"] == []
        assert found.json()["similar_images"][0]["original_filename"] == "a.jpg"

        # Asked to stop in the middle of work, what it has claimed goes back.
        jobs = [
            client.post("/api/v1/upload", files={"file": (f"{n}.jpg", photo_bytes(n))}).json()
            for n in range(2, 30)
        ]
        assert machine.stop("extractor") == 0, machine.log("extractor")
        (machine.folder("extractor") / "heartbeat").unlink(missing_ok=True)
        machine.start("extractor")
        for job in jobs:
            assert ended(client, job["job_id"])["state"] == "succeeded"
        machine.wait_until_healthy("extractor")  # it may have found nothing left to do

        assert client.get("/api/v1/health").json()["status"] == "healthy"
        machine.stop("search-1")
        assert machine.is_healthy("gateway")  # the other shard still answers
        assert not machine.is_healthy("search-1")
        machine.stop("redis")
        assert not machine.is_healthy("redis")
    for service in ("gateway", "extractor", "search-0", "steward"):
        assert machine.stop(service) == 0, machine.log(service)
        assert "Traceback" not in machine.log(service)


def ended(client: httpx2.Client, job_id: str) -> Any:
    while True:
        job = client.get(f"/api/v1/jobs/{job_id}", params={"wait": 30}).json()
        if job["state"] in ("succeeded", "failed"):
            return job
