"""Flower on separate services, by its API and in a browser: photos, failures, queues, workers."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx2
import pytest
import yaml
from PIL import Image
from playwright.sync_api import Browser, expect
from sqlalchemy import select

from shared.catalog.jobs import Job
from shared.jobs.wakeups import WakeupQueue
from tests.support.fleet import Fleet, open_fleet
from tests.support.invariants import count_unfinished_jobs
from tests.support.photos import photo_bytes
from tests.support.server import SERVICES_KEY
from tests.support.servers.daemon import free_ports
from tests.support.waiting import wait_until

ROOT = Path(__file__).parents[2]
COMPOSED = yaml.safe_load((ROOT / "docker-compose.yml").read_text())["services"]["flower"][
    "environment"
]
PHOTOS = 200
BROKEN = {120: "broken-120.jpg", 150: "broken-150.jpg"}
BATCH_PHOTOS = 8


def broken_photo() -> bytes:
    """A JPEG whose header is whole, and whose pixels are cut off."""
    stored = io.BytesIO()
    Image.effect_noise((640, 480), 90).save(stored, "JPEG")
    return stored.getvalue()[: len(stored.getvalue()) // 2]


def states(flower: httpx2.Client) -> Counter[str]:
    return Counter(task["state"] for task in tasks(flower))


@pytest.fixture(scope="module")
def fleet() -> Iterator[Fleet]:
    with open_fleet(
        extractors=2,
        executed=False,
        extractor="test-slow-avg:milliseconds=20,width=256",
        lease_seconds=5.0,
        batch_photos=BATCH_PHOTOS,
    ) as opened:
        opened.start("search-0", "gateway-0", "steward-0")
        yield opened


@pytest.fixture(scope="module")
def flower(fleet: Fleet) -> Iterator[httpx2.Client]:
    (port,) = free_ports(1)
    environment = {
        **os.environ,
        "CELERY_BROKER_URL": fleet.servers.redis.url,
        "CELERY_CONFIG_MODULE": COMPOSED["CELERY_CONFIG_MODULE"],
        "FLOWER_ADDRESS": "127.0.0.1",
        "FLOWER_PORT": str(port),
        "FLOWER_READ_ONLY": "true",
        "FLOWER_TASKS_COLUMNS": COMPOSED["FLOWER_TASKS_COLUMNS"],
        "FLOWER_UNAUTHENTICATED_API": "true",
    }
    command = [str(Path(sys.executable).with_name("celery")), "flower"]
    with subprocess.Popen(command, env=environment) as process:
        with httpx2.Client(base_url=f"http://127.0.0.1:{port}", timeout=30) as client:
            wait_until(lambda: _answers(client))
            yield client
        process.terminate()


def _answers(client: httpx2.Client) -> bool:
    try:
        return client.get("/healthcheck").is_success
    except httpx2.TransportError:
        return False


def upload(fleet: Fleet, number: int) -> None:
    name = BROKEN.get(number, f"photo-{number}.jpg")
    data = broken_photo() if number in BROKEN else photo_bytes(number)
    answer = httpx2.post(
        f"{fleet.gateway_urls[0]}/api/v1/upload",
        files={"file": (name, data)},
        headers={"Authorization": f"Bearer {SERVICES_KEY}"},
        timeout=60,
    )
    assert answer.status_code == 202, answer.text


def queue_lengths(flower: httpx2.Client) -> dict[str, int]:
    found = flower.get("/api/queues/length").json()["active_queues"]
    return {queue["name"]: queue["messages"] for queue in found}


def tasks(flower: httpx2.Client) -> list[dict[str, Any]]:
    return list(flower.get("/api/tasks", params={"limit": 1000}).json().values())


@pytest.mark.timeout(1200)
def test_flower_shows_photos_their_failures_the_queue_and_the_workers(
    fleet: Fleet, flower: httpx2.Client, browser: Browser
) -> None:
    for number in range(PHOTOS):
        upload(fleet, number)
    # No extractor runs yet: the photos wait.
    wait_until(lambda: queue_lengths(flower).get(WakeupQueue.BULK) == PHOTOS)
    wait_until(lambda: states(flower) == {"PENDING": PHOTOS})
    page = browser.new_page()
    url = str(flower.base_url).rstrip("/")
    page.goto(f"{url}/broker")
    expect(page.locator("table")).to_contain_text(str(PHOTOS))

    fleet.start("extractor-0", "extractor-1")
    wait_until(lambda: states(flower)["SUCCESS"] > 20)
    fleet["extractor-0"].kill()
    wait_until(lambda: not count_unfinished_jobs(fleet.catalog))
    # A worker that is killed between the commit of a batch and its events takes these along: its
    # last photos stay "started" in Flower, and are done in the table.
    wait_until(lambda: set(states(flower)) <= {"SUCCESS", "FAILURE", "STARTED"})
    wait_until(lambda: states(flower)["STARTED"] <= BATCH_PHOTOS)
    found = tasks(flower)
    assert {task["name"] for task in found} == {"placewise.index"}
    names = {number: BROKEN.get(number, f"photo-{number}.jpg") for number in range(PHOTOS)}
    shown = {task["kwargs"] for task in found}
    assert shown == {repr({"map": "default", "file": name}) for name in names.values()}
    with fleet.catalog.read() as session:
        jobs = {str(job.id): job for job in session.scalars(select(Job))}
    last_of_killed = [task for task in found if task["state"] == "STARTED"]
    assert len({(task["worker"], jobs[task["uuid"]].worker) for task in last_of_killed}) <= 1
    for task in found:
        job = jobs[task["uuid"]]
        assert job.state == ("failed" if "broken-" in task["kwargs"] else "succeeded")
        if task["state"] == "FAILURE":
            assert job.state == "failed"
            assert task["exception"].startswith("undecodable_photo: "), task
        elif task["state"] == "SUCCESS":
            assert job.state == "succeeded"
            assert task["runtime"] > 0
    wait_until(lambda: not any(queue_lengths(flower).values()))

    workers = {
        worker["hostname"]: worker
        for worker in flower.get("/workers", params={"json": "1"}).json()["data"]
    }
    assert len(workers) == 2
    wait_until(
        lambda: (
            sorted(
                worker["status"]
                for worker in flower.get("/workers", params={"json": "1"}).json()["data"]
            )
            == [False, True]
        )
    )
    (alive,) = [
        worker["hostname"]
        for worker in flower.get("/workers", params={"json": "1"}).json()["data"]
        if worker["status"]
    ]
    stats = flower.get("/api/workers", params={"refresh": "1"}).json()[alive]["stats"]
    assert stats["device"] == "cpu"
    assert any(model.startswith("test-slow") for model in stats["models"])

    page.goto(f"{url}/tasks?state=FAILURE")
    table = page.locator("#tasks-table")
    for name in BROKEN.values():
        expect(table).to_contain_text(name)
    expect(table).to_contain_text("undecodable_photo")
    page.goto(f"{url}/workers")
    expect(page.locator("#workers-table")).to_contain_text(alive)
    page.goto(f"{url}/worker/{alive}")
    page.get_by_role("tab", name="Other").click()
    expect(page.locator("#tab-other")).to_be_visible()
    expect(page.locator("#tab-other")).to_contain_text("cpu")
    expect(page.locator("#tab-other")).to_contain_text("test-slow")
    page.close()
