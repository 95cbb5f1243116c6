"""Many hostile files, through the real upload of a real server."""

from __future__ import annotations

import time
from typing import Any

import httpx2
import psutil

from tests.e2e.hostile_files import MAX_BYTES, MAX_PIXELS, HostileFile, corpus
from tests.support.hostile_headers import MANY_PARTS, heic_of_endless_extents
from tests.support.photos import photo_bytes
from tests.support.server import ServerProcess
from tests.support.waiting import wait_until

SETTINGS = {"max_file_size": MAX_BYTES, "max_image_pixels": MAX_PIXELS}
SECONDS = 240.0
MOST_GROWTH_BYTES = 300_000_000  # of the server with its decoders; the bombs unpack to gigabytes


def memory_of(server: ServerProcess) -> int:
    """Bytes of RAM that the server and its decoding processes have."""
    process = psutil.Process(server.process.pid)
    total = process.memory_info().rss
    for child in process.children(recursive=True):
        try:
            total += child.memory_info().rss
        except psutil.NoSuchProcess:
            continue
    return total


def send(server: ServerProcess, one: HostileFile) -> httpx2.Response:
    return server.client.post("/api/v1/upload", files={"file": (one.filename, one.data)})


def outcomes_of(server: ServerProcess, one: HostileFile, answer: httpx2.Response) -> set[str]:
    """The code that it was refused with, or "succeeded"."""
    body = answer.json()
    if 400 <= answer.status_code < 500:
        assert answer.headers["content-type"] == "application/problem+json"
        return {body["code"]}
    assert answer.status_code in (200, 202), f"{one.name}: {answer.status_code} {answer.text}"
    job: dict[str, Any] = server.finished(body["job_id"], SECONDS)
    return {job["error"]["code"] if job["state"] == "failed" else job["state"]}


def test_each_hostile_file_is_refused_or_handled_and_the_service_goes_on(
    server: ServerProcess,
) -> None:
    files = corpus()
    assert len(files) >= 156
    assert len({one.name for one in files}) == len(files)
    around = {path.name for path in server.home.parent.iterdir()}
    before = most = memory_of(server)
    answers = []
    for one in files:
        answers.append(send(server, one))
        most = max(most, memory_of(server))
    deadline = time.monotonic() + SECONDS
    while True:  # everything that was taken comes to an end
        open_jobs = server.client.get(
            "/api/v1/jobs", params={"state": ["queued", "running"]}
        ).json()["jobs"]
        most = max(most, memory_of(server))
        if not open_jobs:
            break
        assert time.monotonic() < deadline, open_jobs
        time.sleep(0.1)
    wrong = {
        one.name: sorted(outcomes - one.allowed)
        for one, answer in zip(files, answers, strict=True)
        if (outcomes := outcomes_of(server, one, answer)) - one.allowed
    }
    assert wrong == {}

    growth = most - before
    print(f"{len(files)} files; at most {growth / 1e6:.0f} MB more than the {before / 1e6:.0f} MB")
    assert growth < MOST_GROWTH_BYTES
    assert {path.name for path in server.home.parent.iterdir()} == around, "nothing lies beside it"
    assert server.process.poll() is None
    assert server.client.get("/readyz").status_code == 200
    good = server.indexed(photo_bytes(901), "good.jpg")
    body = server.ask(photo_bytes(901)).json()
    assert body["similar_images"][0]["image_id"] == good
    assert "Traceback" not in server.log_path.read_text(errors="replace")


def test_headers_of_too_many_parts_hold_up_no_call_no_batch_and_no_end(
    server: ServerProcess,
) -> None:
    files = {kind: make(400_000) for kind, make in MANY_PARTS.items()}
    files["HEIC: 780 bytes"] = heic_of_endless_extents(780)
    octets = {"Content-Type": "application/octet-stream"}
    for kind, data in files.items():
        answers = [
            server.client.post("/api/v1/photo-headers", content=data, headers=octets),
            server.client.post("/api/v1/upload", files={"file": (kind, data)}),
            server.client.post("/api/v1/similarity", files={"file": (kind, data)}),
        ]
        assert [answer.json()["code"] for answer in answers] == ["undecodable_photo"] * 3, kind

    members = {f"{number}.jpg": data for number, data in enumerate(files.values())}
    members["good.jpg"] = photo_bytes(902)
    with server.no_decoding():  # so that the good photo keeps the batch under way
        answer = server.client.post(
            "/api/v1/upload/batch", files=[("file", member) for member in members.items()]
        )
        job_url = f"/api/v1/jobs/{answer.json()['job_id']}"
        wait_until(
            lambda: server.client.get(job_url).json()["progress"]["failed"] == len(files), SECONDS
        )
        assert server.client.post(f"{job_url}/cancel").json()["state"] == "cancelled"
    assert server.stop() == 0
    server.start()
    assert server.client.get(job_url).json()["state"] == "cancelled"
    items = server.client.get(f"{job_url}/items").json()["items"]
    states = {item["name"]: item["state"] for item in items}
    assert states == dict.fromkeys(members, "failed") | {"good.jpg": "cancelled"}
