"""The catalog is removed, or an older copy of it is there: no object is removed, and every photo
comes back."""

from __future__ import annotations

import json
import shutil
import time
from pathlib import Path
from typing import Any

from tests.support.photos import photo_bytes
from tests.support.server import ServerProcess, environment, run_command

# Everything that no row knows is old enough to be collected.
SETTINGS = {"orphan_age_seconds": 0}


def run(home: Path, *arguments: str, code: int = 0) -> Any:
    done = run_command(*arguments, "--json", env=environment(home), cwd=home.parent)
    assert done.returncode == code, done.stdout + done.stderr
    return json.loads(done.stdout)


def objects(home: Path, prefix: str = "") -> set[str]:
    folder = home / "objects"
    keys = (path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    return {key for key in keys if key.startswith(prefix) and not key.startswith(".")}


def catalog_files(home: Path) -> list[Path]:
    return sorted(home.glob("catalog.sqlite*"))


def said_of(server: ServerProcess, file_id: str) -> dict[str, Any]:
    body: dict[str, Any] = server.client.get(f"/api/v1/uploads/{file_id}").json()
    return body | {"job_id": None}


def found_by(server: ServerProcess, file_id: str) -> list[str]:
    answer = server.similar(file_id, top_k=10)
    assert answer.is_success, answer.text
    return [one["image_id"] for one in answer.json()["similar_images"]]


def test_removed_and_older_catalogs_lose_nothing(tmp_path: Path) -> None:
    home = tmp_path / "home"
    with ServerProcess(home) as server:
        photos = [
            server.indexed(
                photo_bytes(n), f"{n}.jpg", latitude=45, longitude=7 + n, place="hall", tags="a,b"
            )
            for n in (1, 2, 3)
        ]
        server.stop()
        older = tmp_path / "older"
        older.mkdir()
        for file in catalog_files(home):
            shutil.copy(file, older)

        server.start()
        later = server.indexed(photo_bytes(4), "later.jpg", place="later")
        deleted = photos.pop()
        assert server.client.delete(f"/api/v1/uploads/{deleted}").is_success
        retained = [*photos, later]
        fields = {file_id: said_of(server, file_id) for file_id in retained}
        found = {file_id: found_by(server, file_id) for file_id in retained}
        wait_for_journal(home, server)
        server.stop()
        originals = objects(home, "originals/")
        assert len(originals) == 3

        # The catalog is gone.
        for file in catalog_files(home):
            file.unlink()
        taken = run(home, "storage", "rebuild")
        assert (taken["photos"], taken["descriptors"], taken["queued_photos"]) == (3, 3, 0)
        server.start()
        assert {file_id: said_of(server, file_id) for file_id in retained} == fields
        assert {file_id: found_by(server, file_id) for file_id in retained} == found
        assert server.client.get(f"/api/v1/uploads/{deleted}").status_code == 404
        assert run(home, "storage", "verify", "--originals")["faults"] == []
        server.stop()
        assert objects(home, "originals/") == originals
        assert run(home, "storage", "rebuild", code=1)["code"] == "catalog_not_empty"

    # An older catalog is there: a backup is refused, and a rebuild has everything again.
    for file in catalog_files(home):
        file.unlink()
    for file in older.iterdir():
        shutil.copy(file, home)
    before = objects(home)
    assert (
        run(home, "storage", "backup", str(tmp_path / "backup"), code=1)["code"] == "catalog_behind"
    )
    assert objects(home) == before
    for file in catalog_files(home):
        file.unlink()
    assert run(home, "storage", "rebuild")["photos"] == 3
    with ServerProcess(home, **SETTINGS) as server:
        assert {file_id: said_of(server, file_id) for file_id in retained} == fields
        assert {file_id: found_by(server, file_id) for file_id in retained} == found
        assert server.client.get(f"/api/v1/uploads/{deleted}").status_code == 404
        assert run(home, "storage", "verify", "--originals")["faults"] == []


def wait_for_journal(home: Path, server: ServerProcess) -> None:
    """Until the deleted photo's bytes are gone: they go after the journal tells of it."""
    deadline = time.monotonic() + 90
    while len(objects(home, "originals/")) > 3:
        assert time.monotonic() < deadline, server.log()
        time.sleep(0.1)
