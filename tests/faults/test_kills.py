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

from shared.catalog.database.session import Catalog
from shared.storage import FolderStore
from tests.support.invariants import count_unfinished_jobs, find_violations
from tests.support.photos import photo_bytes
from tests.support.server import ServerProcess
from tests.support.servers.daemon import has_ended
from tests.support.waiting import wait_until

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
        wait_until(lambda: not count_unfinished_jobs(catalog), 60)
        expected = {
            hashlib.sha256(photo_bytes(number)).hexdigest(): UUID(file_id)
            for number, file_id in uploader.acknowledged.items()
        }
        assert not find_violations(catalog, FolderStore(server.home / "objects"), expected)
        catalog.close()
        assert_each_finds_itself(server, uploader.acknowledged)


def test_decoding_children_end_with_a_killed_server(tmp_path: Path) -> None:
    with ServerProcess(tmp_path / "home") as server:
        server.indexed(photo_bytes(1))
        children = psutil.Process(server.process.pid).children(recursive=True)
        assert children
        server.kill()
        wait_until(lambda: all(has_ended(child) for child in children), 20)


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


def assert_each_finds_itself(server: ServerProcess, acknowledged: dict[int, str]) -> None:
    for number in range(0, PHOTOS, 10):
        found = server.ask(photo_bytes(number), top_k=2).json()["similar_images"]
        assert found[0]["image_id"] == acknowledged[number]
        assert found[0]["similarity_score"] > 0.9995  # the rows are float16
        assert found[1]["image_id"] != acknowledged[number]
