"""`placewise search`: processes of their own that serve what an embedded Placewise has stored."""

from __future__ import annotations

import contextlib
import re
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from uuid import UUID

import httpx2

from shared.catalog.chunks import find_descriptor
from shared.catalog.database.session import Catalog
from shared.catalog.generations import active_generation
from shared.catalog.maps import get_map
from shared.catalog.processes import RegisteredSearchWorker
from shared.search_api.client import HttpSearchClient
from shared.search_api.protocol import SearchRequest, SearchResponse
from tests.support.photos import photo_bytes
from tests.support.processes import PLACEWISE, Process, start
from tests.support.server import START_SECONDS, ServerProcess, environment

# One slot a photo, so that both shards have some.
SETTINGS = {"slot_rows": 2, "batch_photos": 1}
PHOTOS = 4


@contextlib.contextmanager
def search_process(home: Path, log: Path, **settings: Any) -> Iterator[tuple[Process, str]]:
    """A running `placewise search` and its address."""
    with log.open("wb") as reported:
        env = environment(home, **settings)
        process = start(
            [PLACEWISE, "search"], env=env, cwd=home.parent, stdout=reported, stderr=reported
        )
    try:
        deadline = time.monotonic() + START_SECONDS
        while not (match := re.search(r"on (http://\S+)", log.read_text())):
            assert process.poll() is None, log.read_text()
            assert time.monotonic() < deadline, log.read_text()
            time.sleep(0.05)
        yield process, match[1]
    finally:
        process.kill()
        process.wait()


def ask(port: HttpSearchClient, home: Path, file_id: str) -> SearchResponse:
    """The photos most similar to a stored one, searched in the shards without a gateway."""
    catalog = Catalog(f"sqlite:///{home / 'catalog.sqlite'}")
    with catalog.read() as session:
        map_ = get_map(session, "default")
        generation = active_generation(session, map_.id)
        assert generation is not None
        found = find_descriptor(session, generation.id, UUID(file_id))
        assert found is not None
        request = SearchRequest(
            generation_id=generation.id,
            object_key=found[1].object_key,
            row=found[0].row,
            min_version=map_.version,
            k=PHOTOS,
        )
    catalog.close()
    return port.search(request)


def names(home: Path) -> list[str]:
    catalog = Catalog(f"sqlite:///{home / 'catalog.sqlite'}")
    with catalog.read() as session:
        found = [f"{w.shard}/{w.shards}" for w in session.query(RegisteredSearchWorker)]
    catalog.close()
    return sorted(found)


def test_two_search_processes_answer_what_the_embedded_one_answers(
    server: ServerProcess, tmp_path: Path
) -> None:
    file_ids = [server.indexed(photo_bytes(number)) for number in range(1, PHOTOS)]
    with (
        search_process(server.home, tmp_path / "0.log", search_shard="0/2") as (first, first_url),
        search_process(server.home, tmp_path / "1.log", search_shard="1/2") as (_, second_url),
        HttpSearchClient([first_url, second_url], 10.0) as port,
    ):
        answer = ask(port, server.home, file_ids[0])
        assert (len(answer.hits), answer.missing) == (PHOTOS, ())
        rows = [httpx2.get(f"{url}/status").json()["rows"] for url in (first_url, second_url)]
        assert sum(rows) == PHOTOS
        assert min(rows) > 0
        embedded = server.similar(file_ids[0], top_k=PHOTOS).json()["similar_images"]
        others = [str(hit.photo_id) for hit in answer.hits if str(hit.photo_id) != file_ids[0]]
        assert others == [image["image_id"] for image in embedded]
        for url in (first_url, second_url):
            deadline = time.monotonic() + START_SECONDS
            while httpx2.get(f"{url}/readyz").status_code != 200:
                assert time.monotonic() < deadline
                time.sleep(0.05)
        assert names(server.home) == ["0/1", "0/2", "1/2"]

        # A model change is answered from by every process as soon as it is done.
        job = server.client.post("/api/v1/generations", json={}).json()["job_id"]
        assert server.finished(job)["state"] == "succeeded"
        assert len(ask(port, server.home, file_ids[0]).hits) == PHOTOS

        first.send_signal(signal.SIGTERM)
        assert first.wait(timeout=30) == 0, (tmp_path / "0.log").read_text()
        assert names(server.home) == ["0/1", "1/2"], "it has signed off"
        assert ask(port, server.home, file_ids[0]).missing == ("shard 0/2",)
