"""Uploads of local photos, and the lists that name them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from rich.progress import Progress

from placewise.client import Client
from services.cli.ingest.geotags import LocalPhoto, read_photo_manifest
from services.cli.ingest.upload import upload_photos
from shared.errors import InvalidRequest
from tests.support.api_responses import JOB, STATS, UPLOADED
from tests.support.fake_server import FakeServer

NO_JOBS: dict[str, Any] = {"jobs": [], "next_cursor": None}


@pytest.fixture
def photo(tmp_path: Path) -> LocalPhoto:
    path = tmp_path / "1.jpg"
    path.write_bytes(b"one")
    return LocalPhoto(path, {"latitude": "45.5"})


def test_photos_that_wait_for_a_vocabulary_are_not_waited_for_one_by_one(
    server: FakeServer, photo: LocalPhoto
) -> None:
    server.will_answer(200, STATS)
    server.will_answer(202, UPLOADED)
    waiting = {**JOB, "state": "queued", "waiting_for": "vocabulary"}
    for answer in (waiting, STATS, NO_JOBS, waiting, STATS):
        server.will_answer(200, answer)
    with Client(server.url, patience_seconds=0) as client:
        report = upload_photos(client, [photo], Progress(disable=True))
    assert report["failed"] == []
    polls = [path for _, path, _ in server.requests if path.startswith("/api/v1/jobs/")]
    assert len(polls) == 2
    assert all("wait=0" in path for path in polls), polls


def test_a_list_that_names_a_missing_photo_is_refused_by_its_line(tmp_path: Path) -> None:
    (tmp_path / "1.jpg").write_bytes(b"one")
    data = b'{"filename": "1.jpg"}\n{"filename": "2.jpg"}\n'
    with pytest.raises(InvalidRequest) as caught:
        read_photo_manifest(tmp_path / "list.jsonl", data)
    assert caught.value.code == "bad_manifest"
    assert [error["line"] for error in caught.value.extra["errors"]] == [2]
