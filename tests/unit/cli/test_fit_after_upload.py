"""How `placewise index` follows the vocabulary fit that the server starts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from rich.progress import Progress

from placewise.client import Client
from services.cli import client as cli_client
from services.cli.ingest import upload
from services.cli.ingest.geotags import LocalPhoto
from services.cli.ingest.upload import wait_for_automatic_fit
from shared.config.embedded_home import RunningServer
from shared.errors import StorageFull, Unavailable
from tests.support.api_responses import JOB, STATS, UPLOADED
from tests.support.fake_server import running_server

FIT = {**JOB, "kind": "fit", "label": "Improving the map", "state": "running"}
ENDED = {**FIT, "state": "succeeded"}


def wait(
    *answers: Any, photos: int = 50, next_fit: int | None = 50
) -> tuple[str | None, list[str]]:
    """The state of the fit on a server with this map; the methods of the requests."""
    with running_server() as server, Client(server.url, patience_seconds=0) as client:
        for answer in ({**STATS, "total_images": photos, "next_fit_photos": next_fit}, *answers):
            server.will_answer(200, answer)
        job = wait_for_automatic_fit(client, Progress(disable=True))
        assert not server.answers
        return job.state if job else None, [method for method, _, _ in server.requests]


def test_upload_to_a_full_disk_ends(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (photo := tmp_path / "a.jpg").write_bytes(b"a photo")
    monkeypatch.setattr(upload, "RETRY_PERIOD_SECONDS", 0.0)
    with running_server() as server, Client(server.url, patience_seconds=0) as client:
        server.will_answer(200, STATS)
        for _ in range(8):
            server.will_answer(507, StorageFull("disk_full", "The disk is full.").as_problem())
        with pytest.raises(StorageFull):
            upload.upload_photos(client, [LocalPhoto(photo, {})] * 100, Progress(disable=True))


def test_photos_are_awaited_while_the_server_is_away(tmp_path: Path) -> None:
    (photo := tmp_path / "a.jpg").write_bytes(b"a photo")
    away = Unavailable("server_unreachable", "It is restarted.").as_problem()
    ended = {**JOB, "state": "succeeded"}
    answers = [STATS, UPLOADED, away, ended, away, STATS, jobs(), away, STATS]
    with running_server() as server, Client(server.url, patience_seconds=0) as client:
        for answer in answers:
            server.will_answer(503 if answer is away else 200, answer)
        report = upload.upload_photos(client, [LocalPhoto(photo, {})], Progress(disable=True))
    assert (report["uploaded"], report["failed"]) == (1, [])


def test_a_server_that_has_ended_with_its_command_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    ended = RunningServer("http://127.0.0.1:9")
    monkeypatch.setattr(cli_client, "find_running_server", lambda *_: ended)
    with (
        pytest.raises(Unavailable, match="has ended, perhaps with the command"),
        cli_client.connect(None, None, None) as client,
    ):
        client.stats()


def jobs(*listed: Any) -> dict[str, Any]:
    return {"jobs": list(listed), "next_cursor": None}


def test_a_running_fit_and_the_one_that_is_due_then_are_awaited_and_no_other_is_started() -> None:
    due = {**STATS, "total_images": 81, "next_fit_photos": 50}
    fit = (jobs(FIT), FIT, ENDED)
    state, requests = wait(*fit, due, *fit, STATS, jobs(), photos=1)
    assert (state, set(requests)) == ("succeeded", {"GET"})


@pytest.mark.parametrize(("photos", "next_fit"), [(49, 50), (500, None)])
def test_no_fit_is_awaited_for_a_map_that_is_not_due(photos: int, next_fit: int | None) -> None:
    assert wait(jobs(), photos=photos, next_fit=next_fit)[0] is None


def test_a_fit_that_starts_and_ends_between_two_polls_is_reported() -> None:
    fitted = {**STATS, "total_images": 50, "next_fit_photos": 100}
    state, _ = wait(jobs(), fitted, jobs(), jobs(ENDED), ENDED, fitted, jobs())
    assert state == "succeeded"


def test_a_fit_that_failed_leaves_the_upload_a_success(capsys: pytest.CaptureFixture[str]) -> None:
    error = {"type": "urn:a", "title": "t", "status": 422, "code": "change_loses_photos"}
    failed = {**FIT, "state": "failed", "error": {**error, "detail": "Too many failed."}}
    assert wait(jobs(FIT), failed, failed)[0] == "failed"
    assert "Too many failed." in " ".join(capsys.readouterr().err.split())
