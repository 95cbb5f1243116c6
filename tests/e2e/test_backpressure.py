"""A busy server: a command waits until the queue has room, and goes on."""

from __future__ import annotations

import json
from pathlib import Path

from tests.support.photos import photo_bytes
from tests.support.server import ServerProcess, environment, run_command

SETTINGS = {"max_queued_jobs": 1}
PHOTOS = 5


def test_index_waits_for_a_full_queue_says_so_and_goes_on(
    server: ServerProcess, tmp_path: Path
) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    for number in range(PHOTOS):
        (folder / f"{number}.jpg").write_bytes(photo_bytes(300 + number))
    ended = run_command(
        *("index", folder, "--no-fit", "--json"), env=environment(server.home), cwd=tmp_path
    )
    assert ended.returncode == 0, ended.stderr
    report = json.loads(ended.stdout)
    assert (report["uploaded"], report["refused"], report["failed"]) == (PHOTOS, [], [])
    assert "Retrying:" in ended.stderr
    assert "The queue is full" in ended.stderr
