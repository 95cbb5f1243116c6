"""Kill -9 at any moment, then count: nothing acknowledged is lost, nothing is there twice."""

from __future__ import annotations

import hashlib
import random
import threading
import time
from pathlib import Path
from uuid import UUID

import httpx2
import psutil

from lab.benchmarks.invariants import check_invariants, count_unfinished_jobs
from shared.catalog.database.session import Catalog
from shared.storage import FolderStore
from tests.support.photos import photo_bytes
from tests.support.server import ServerProcess
from tests.support.servers.daemon import has_ended

PHOTOS = 75
KILLS = 5
AGAIN_SECONDS = 0.05
UPLOAD_SECONDS = 120.0


class Uploader(threading.Thread):
    """Uploads each photo until it is acknowledged, whatever happens to the server."""

    def __init__(self, server: ServerProcess) -> None:
        super().__init__(name="uploader")
        self.acknowledged: dict[int, str] = {}
        self.unexpected: list[str] = []
        self._server = server
        self.may_go_on_to = 0

    def run(self) -> None:
        for number in range(PHOTOS):
            while number >= self.may_go_on_to:
                time.sleep(0.001)
            deadline = time.monotonic() + UPLOAD_SECONDS
            while number not in self.acknowledged and time.monotonic() < deadline:
                self._try(number)

    def _try(self, number: int) -> None:
        try:
            answer = self._server.upload(photo_bytes(number), f"{number}.jpg")
        except (httpx2.TransportError, RuntimeError):
            # RuntimeError: the server was restarted and its client replaced under this call.
            time.sleep(AGAIN_SECONDS)
            return
        if answer.status_code in (200, 202):
            self.acknowledged[number] = answer.json()["file_id"]
        else:
            self.unexpected.append(answer.text)
            time.sleep(AGAIN_SECONDS)


def test_after_five_kills_every_acknowledged_photo_is_searchable_exactly_once(
    tmp_path: Path,
) -> None:
    moments = random.Random(20_261_121)
    with ServerProcess(tmp_path / "home", batch_photos=3) as server:
        uploader = Uploader(server)
        uploader.start()
        for kill in range(1, KILLS + 1):
            uploader.may_go_on_to = kill * PHOTOS // (KILLS + 1)
            # Somewhere among this life's uploads, or while their batches are described.
            reference = moments.randint(
                (kill - 1) * PHOTOS // (KILLS + 1), uploader.may_go_on_to - 1
            )
            while len(uploader.acknowledged) < reference:
                time.sleep(0.001)
            time.sleep(moments.uniform(0, 0.4))
            server.kill()
            server.start()
        uploader.may_go_on_to = PHOTOS
        uploader.join(timeout=UPLOAD_SECONDS)
        assert not uploader.unexpected
        assert len(uploader.acknowledged) == PHOTOS

        catalog = Catalog(f"sqlite:///{server.home / 'catalog.sqlite'}")
        wait_until_nothing_is_left_to_do(catalog)
        expected = {
            hashlib.sha256(photo_bytes(number)).hexdigest(): UUID(file_id)
            for number, file_id in uploader.acknowledged.items()
        }
        counts = check_invariants(catalog, FolderStore(server.home / "objects"), expected)
        assert counts.none_found, counts
        catalog.close()
        assert_each_finds_itself(server, uploader.acknowledged)


def test_decoding_children_end_with_a_killed_server(tmp_path: Path) -> None:
    with ServerProcess(tmp_path / "home") as server:
        server.indexed(photo_bytes(1))
        children = psutil.Process(server.process.pid).children(recursive=True)
        assert children
        server.kill()
        deadline = time.monotonic() + 20
        while not all(has_ended(child) for child in children):
            assert time.monotonic() < deadline, children
            time.sleep(0.05)


def test_a_server_whose_extractor_is_killed_ends_and_describes_the_photo_when_started_again(
    tmp_path: Path,
) -> None:
    with ServerProcess(tmp_path / "home") as server:
        server.indexed(photo_bytes(1))
        (extractor,) = psutil.Process(server.process.pid).children()
        uploaded = server.upload(photo_bytes(2)).json()
        extractor.kill()
        assert server.process.wait(60) == 1
        assert "extractor_ended: The extractor's process ended with code -9" in server.log()
        server.start()
        assert server.finished(uploaded["job_id"])["state"] == "succeeded"


def wait_until_nothing_is_left_to_do(catalog: Catalog) -> None:
    deadline = time.monotonic() + 60
    while left := count_unfinished_jobs(catalog):
        assert time.monotonic() < deadline, f"{left} jobs are stuck"
        time.sleep(0.1)


def assert_each_finds_itself(server: ServerProcess, acknowledged: dict[int, str]) -> None:
    for number in range(0, PHOTOS, 10):
        found = server.ask(photo_bytes(number), top_k=2).json()["similar_images"]
        assert found[0]["image_id"] == acknowledged[number]
        assert found[0]["similarity_score"] > 0.9995  # the rows are float16
        assert found[1]["image_id"] != acknowledged[number]
