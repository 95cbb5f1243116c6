"""DEBUG and UPLOAD_DIR, as the predecessor's `.env` has them."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.photos import photo_bytes
from tests.support.problems import problem
from tests.support.server import ServerProcess, environment, run_command


def test_original_photos_lie_in_the_upload_dir(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    with ServerProcess(tmp_path / "home", upload_dir=photos) as server:
        file_id = server.indexed(photo_bytes(1))
        server.indexed(photo_bytes(2))
        stored = [path for path in photos.iterdir() if not path.name.startswith(".")]
        assert {path.read_bytes() for path in stored} == {photo_bytes(1), photo_bytes(2)}
        assert not (server.home / "objects" / "originals").exists()
        assert server.stop() == 0

        server.start()
        image = server.client.get(f"/api/v1/uploads/{file_id}/image")
        assert image.content == photo_bytes(1)
        assert server.similar(file_id).json()["total_similar"] == 1
        assert server.stop() == 0

        ended = run_command("serve", env=environment(server.home), cwd=tmp_path)
        assert ended.returncode == 1
        assert ended.stderr.startswith("upload_dir_changed: ")
        assert str(photos) in ended.stderr


def test_an_upload_dir_that_can_not_work_is_refused_at_the_start(tmp_path: Path) -> None:
    home = tmp_path / "home"
    inside = home / "objects" / "photos"
    env = environment(home, upload_dir=inside, host="0.0.0.0")
    ended = run_command("serve", env=env, cwd=tmp_path)
    assert ended.returncode == 1
    assert ended.stderr.startswith("upload_dir_overlaps: ")
    assert "Traceback" not in ended.stderr
    assert not list(home.glob("admin-key*")), "a start that shows no key makes none"


@pytest.mark.parametrize("debug", [True, False])
def test_debug_logs_calls_and_refusals_and_changes_no_answer(tmp_path: Path, debug: bool) -> None:
    with ServerProcess(tmp_path / "home", debug=debug, admin_key="0123456789-secret") as server:
        server.indexed(photo_bytes(1))
        refusal = problem(server.client.get("/api/v1/jobs?cursor=odd"), 422, "invalid_field")
        missing = problem(
            server.client.get("/api/v1/jobs", headers={"Authorization": "Basic no"}),
            401,
            "key_missing",
        )
        for body in (refusal, missing):
            assert set(body) <= {
                *("type", "title", "status", "detail", "code", "instance", "errors")
            }
        log = server.log_path.read_text()
        assert ("GET /api/v1/jobs: 422" in log) is debug
        assert ("/api/v1/jobs: cursor" in log) is debug
        assert ("/api/v1/jobs: key_missing" in log) is debug
        assert "SELECT" not in log
        assert "0123456789-secret" not in log
        assert "Bearer pw_" not in log
