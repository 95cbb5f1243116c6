"""Flower, started as docker-compose.yml starts it, beside a real Redis and an extractor."""

from __future__ import annotations

import ast
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx2
import pytest

from shared.catalog.database.session import Catalog
from shared.config.settings import Settings
from shared.jobs.celery_wakeups import DRAIN_TASK, CeleryWakeups, create_celery_app
from shared.jobs.wakeups import WakeupQueue
from shared.storage import FolderStore
from tests.deploy.composition import SERVICES, make_env, services, variables
from tests.deploy.machine import Machine
from tests.support.catalog_rows import add_map, upload
from tests.support.photos import photo_bytes
from tests.support.servers import PostgresServer

SECONDS = 60.0
PHOTOS = 12
FOLDER_STORE = {"S3_ENDPOINT": "", "S3_ACCESS_KEY": "", "S3_SECRET_KEY": ""}


def until(what: Any) -> Any:
    deadline = time.monotonic() + SECONDS
    while not (found := what()):
        assert time.monotonic() < deadline, "it did not come to that"
        time.sleep(0.1)
    return found


@pytest.fixture
def catalog_on_postgres(postgres: PostgresServer, migrated_postgres: str) -> Iterator[Catalog]:
    opened = Catalog(postgres.new_database(migrated_postgres))
    yield opened
    opened.close()


@pytest.fixture
def values(tmp_path: Path) -> dict[str, str]:
    return variables(make_env(tmp_path))


@pytest.fixture
def machine(tmp_path: Path, values: dict[str, str]) -> Iterator[Machine]:
    made = Machine(tmp_path / "machine", services(SERVICES, tmp_path, values), {})
    try:
        made.start("redis")
        made.wait_until_healthy("redis")
        made.start("flower")
        made.wait_until_healthy("flower")
        yield made
    finally:
        made.close()


@pytest.fixture
def flower(machine: Machine, values: dict[str, str]) -> Iterator[httpx2.Client]:
    key = ("flower", values["FLOWER_PASSWORD"])
    with httpx2.Client(base_url=machine.url("flower"), auth=key, timeout=30) as client:
        yield client


def test_flower_shows_what_a_drain_did_and_only_to_who_has_the_password(
    machine: Machine,
    flower: httpx2.Client,
    catalog_on_postgres: Catalog,
    values: dict[str, str],
    tmp_path: Path,
) -> None:
    for path in ("/", "/workers", "/tasks", "/api/tasks", "/api/workers"):
        for wrong in (None, ("flower", "guessed")):
            assert httpx2.get(machine.url("flower") + path, auth=wrong).status_code == 401, path
    assert flower.get("/api/tasks").json() == {}

    home = tmp_path / "home"
    store = FolderStore(home / "objects", exclusive=False)
    with catalog_on_postgres.write() as session:
        map_id = add_map(session, "default", "test-tiny-avg").id
    for number in range(PHOTOS):
        upload(catalog_on_postgres, store, map_id, photo_bytes(number))
    machine.start(
        "extractor",
        **FOLDER_STORE,
        DATABASE_URL=catalog_on_postgres.url.render_as_string(hide_password=False),
        PLACEWISE_HOME=str(home),
        EXTRACTOR="test-tiny-avg",
        ALLOW_TEST_EXTRACTORS="true",
        DECODE_PROCESSES="1",
    )
    machine.wait_until_healthy("extractor")

    settings = Settings(
        redis_url=f"redis://:{values['REDIS_PASSWORD']}@127.0.0.1:{machine.port('redis')}/0"
    )
    app = create_celery_app(settings)
    wakeups = CeleryWakeups(app, settings)
    try:
        until(lambda: flower.get("/workers", params={"json": "1"}).json()["data"])
        for number in range(PHOTOS, 2 * PHOTOS):
            upload(catalog_on_postgres, store, map_id, photo_bytes(number))
        wakeups.send(WakeupQueue.BULK)

        # Drains of before Flower knew the worker need not be there.
        def drains() -> list[dict[str, Any]]:
            tasks = flower.get("/api/tasks").json().values()
            done = [task for task in tasks if task["state"] == "SUCCESS"]
            assert {task["name"] for task in done} <= {DRAIN_TASK}
            return [read for task in done if (read := ast.literal_eval(task["result"]))["claimed"]]

        result = until(drains)[-1]
        assert set(result) == {"maps", "claimed", "succeeded", "failed", "seconds"}
        assert result["maps"] == [str(map_id)]
        assert result["succeeded"] == result["claimed"] > 0
        assert result["failed"] == 0
        assert {"decode", "describe", "publish"} <= set(result["seconds"])
        assert all(took >= 0 for took in result["seconds"].values())

        # Between two drains it answers.
        answers = until(lambda: app.control.inspect(timeout=5).ping())
        assert list(answers.values()) == [{"ok": "pong"}]
        # What it shows can't be changed by it.
        name = next(iter(answers))
        for path in (f"/api/worker/shutdown/{name}", f"/api/task/send-task/{DRAIN_TASK}"):
            assert flower.post(path).status_code == 403
    finally:
        wakeups.close()
        app.close()
    assert machine.stop("extractor") == 0, machine.log("extractor")
    assert machine.stop("flower") == 0, machine.log("flower")
