"""A busy server: a command waits until the queue has room, and goes on."""

from __future__ import annotations

from pathlib import Path

from tests.support.photos import photo_bytes
from tests.support.server import CommandLine, ServerProcess

SETTINGS = {"max_queued_jobs": 1}
PHOTOS = 5


def test_index_waits_for_a_full_queue_says_so_and_goes_on(
    server: ServerProcess, tmp_path: Path
) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    for number in range(PHOTOS):
        (folder / f"{number}.jpg").write_bytes(photo_bytes(300 + number))
    ended = CommandLine(tmp_path, server.home)("index", folder, "--no-fit", "--json")
    report = ended.json()
    assert (report["uploaded"], report["refused"], report["failed"]) == (PHOTOS, [], [])
    assert "Retrying:" in ended.stderr
    assert "The queue is full" in ended.stderr
