"""A journal: what a server has taken is not sent again, whatever cut the run off."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from rich.progress import Progress

from placewise.answers import Uploaded
from placewise.client import Client
from services.cli.ingest.geotags import LocalPhoto, read_photo_manifest
from services.cli.ingest.upload import upload_photos
from services.cli.ingest.upload_journal import UploadJournal
from shared.errors import InvalidRequest
from tests.support.api_responses import JOB, JOB_ID, PHOTO_ID, STATS, UPLOADED
from tests.support.fake_server import FakeServer

TAKEN = Uploaded(**UPLOADED)
NO_JOBS: dict[str, Any] = {"jobs": [], "next_cursor": None}


@pytest.fixture
def photo(tmp_path: Path) -> LocalPhoto:
    path = tmp_path / "1.jpg"
    path.write_bytes(b"one")
    return LocalPhoto(path, {"latitude": "45.5"})


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "journal.jsonl"


def test_a_taken_photo_is_known_to_the_next_run_until_its_bytes_or_its_metadata_change(
    path: Path, photo: LocalPhoto
) -> None:
    with UploadJournal(path, "http://a", None) as journal:
        assert journal.done(photo) is None
        journal.add(photo, TAKEN)
    with UploadJournal(path, "http://a", None) as journal:
        done_before = journal.done(photo)
        assert done_before is not None
        assert (done_before["file_id"], done_before["job_id"]) == (PHOTO_ID, JOB_ID)
        assert journal.done(LocalPhoto(photo.path, {"place": "hall"})) is None
        photo.path.write_bytes(b"another")
        assert journal.done(photo) is None
        photo.path.unlink()
        assert journal.done(photo) is None


def test_a_line_that_a_kill_has_cut_off_is_passed_over(path: Path, photo: LocalPhoto) -> None:
    with UploadJournal(path, "http://a", None) as journal:
        journal.add(photo, TAKEN)
    whole = path.read_text()
    path.write_text(whole[:-20])
    with UploadJournal(path, "http://a", None) as journal:
        assert journal.done(photo) is None
        journal.add(photo, TAKEN)
    with UploadJournal(path, "http://a", None) as journal:
        assert journal.done(photo) is not None


@pytest.mark.parametrize("other", [("http://b", None), ("http://a", "lab")])
def test_a_journal_of_another_server_or_map_is_refused(
    path: Path, other: tuple[str, str | None]
) -> None:
    UploadJournal(path, "http://a", None).__exit__(None, None, None)
    with pytest.raises(InvalidRequest) as caught:
        UploadJournal(path, *other)
    assert caught.value.code == "bad_journal"


def test_a_file_that_is_no_journal_is_refused_and_left_alone(path: Path) -> None:
    path.write_text("my notes\n")
    with pytest.raises(InvalidRequest):
        UploadJournal(path, "http://a", None)
    assert path.read_text() == "my notes\n"


def uploads(server: FakeServer) -> int:
    return sum(request[1].startswith("/api/v1/upload") for request in server.requests)


def test_photos_that_wait_for_a_vocabulary_are_not_waited_for_one_by_one(
    server: FakeServer, photo: LocalPhoto
) -> None:
    server.will_answer(200, STATS)
    server.will_answer(202, UPLOADED)
    waiting = {**JOB, "state": "queued", "waiting_for": "vocabulary"}
    for answer in (waiting, STATS, NO_JOBS, waiting, STATS):
        server.will_answer(200, answer)
    with Client(server.url) as client:
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
