"""What `docker build` sends: .dockerignore lets the service through, and not the lab."""

from __future__ import annotations

from pathlib import Path

from tests.deploy.images.image import copy_build_context


def test_the_service_is_sent_and_the_lab_is_not(tmp_path: Path) -> None:
    copy_build_context(tmp_path / "context")
    sent = {path.name for path in (tmp_path / "context").iterdir() if path.is_dir()}
    assert sent == {"deploy", "placewise", "services", "shared"}, "deploy has the Dockerfile only"
