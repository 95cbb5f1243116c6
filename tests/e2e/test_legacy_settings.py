"""The `.env` and the calls of the AnyLoc service, as its README prints them."""

from __future__ import annotations

import json
from pathlib import Path

from tests.support.photos import photo_bytes
from tests.support.problems import problem
from tests.support.server import START_SECONDS, ServerProcess, environment, run_command
from tests.support.waiting import wait_until


def test_original_photos_lie_in_the_upload_dir(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    with ServerProcess(tmp_path / "home", upload_dir=photos) as server:
        file_id = server.indexed(photo_bytes(1))
        server.indexed(photo_bytes(2), "Market Street.PNG")
        stored = [path for path in photos.iterdir() if not path.name.startswith(".")]
        assert {path.read_bytes() for path in stored} == {photo_bytes(1), photo_bytes(2)}
        assert sorted(path.suffix for path in stored) == [".jpg", ".png"]
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


# As the predecessor's README prints it.
PUBLISHED_ENV = """
# API Configuration
DEBUG=false
HOST=0.0.0.0
PORT=8000

# File Handling
MAX_FILE_SIZE=10485760  # 10MB
UPLOAD_DIR=./uploads

# AnyLoc Settings
DEVICE=auto
DINO_MODEL=dinov2_vitg14
DESC_LAYER=31
DESC_FACET=value
VLAD_CLUSTERS=64
VLAD_DESC_DIM=1536
"""


def test_the_published_env_and_calls_work_and_health_names_the_missing_weights(
    tmp_path: Path,
) -> None:
    (tmp_path / ".env").write_text(PUBLISHED_ENV)
    # HOST and PORT of the environment have priority; without weights nothing is downloaded.
    server = ServerProcess(tmp_path / "home", dino_weights=tmp_path / "nowhere.pth", device="cpu")
    del server._environment["EXTRACTOR"]
    with server:
        call = server.client.request
        wait_until(lambda: call("GET", "/api/v1/health").status_code != 200, START_SECONDS, 0.5)
        health = call("GET", "/api/v1/health")
        part = health.json()["parts"]["extractors"]
        assert (health.json()["status"], part["status"]) == ("degraded", "degraded")
        assert "weights_missing" in part["detail"]
        assert part["processes"][0]["device"] == "cpu"

        uploaded = call(
            "POST",
            "/api/v1/upload",
            files={"file": ("street.jpg", photo_bytes(1))},
            headers={"Prefer": "wait=10"},  # all of it passes
        )
        assert uploaded.status_code == 202
        assert "nowhere.pth" in uploaded.json()["message"]
        file_id = uploaded.json()["file_id"]
        problem(call("POST", f"/api/v1/similarity/{file_id}?top_k=5"), 409, "not_searchable")
        stats = call("GET", "/api/v1/database/stats").json()
        assert (stats["total_images"], stats["device"]) == (1, "cpu")
        found = call("GET", "/api/v1/search?filename=street&upload_after=2020-01-01").json()
        assert [image["image_id"] for image in found["images"]] == [file_id]
        assert (tmp_path / "uploads").is_dir()
        doctor = run_command("doctor", "--json", env=server._environment, cwd=tmp_path)
        details = {each["part"]: each["detail"] for each in json.loads(doctor.stdout)}
        assert "can't be loaded (weights_missing)" in details["server extractors"]
        assert f"DINO_WEIGHTS={tmp_path}/nowhere.pth does not exist" in details["extractor"]
        assert "waiting for a vocabulary" not in doctor.stdout
        assert call("DELETE", f"/api/v1/uploads/{file_id}").is_success
        assert call("GET", "/docs").is_success
        assert call("GET", "/redoc").is_success
