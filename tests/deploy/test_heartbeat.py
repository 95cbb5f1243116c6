"""A heartbeat's file, and the check that an orchestrator runs."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

from services.extractor.worker import ExtractorWorker
from shared.catalog.database.session import Catalog
from shared.config.settings import Settings
from shared.storage import FolderStore
from shared.telemetry.heartbeat import Heartbeat, seconds_since_heartbeat


def check(file: Path, seconds: float) -> int:
    command = [sys.executable, "-m", "shared.telemetry.heartbeat", str(file), str(seconds)]
    return subprocess.run(command, capture_output=True, check=False).returncode


def test_check_is_good_after_a_beat_and_bad_before_the_first_and_after_a_silence(
    tmp_path: Path,
) -> None:
    file = tmp_path / "heartbeat"
    assert check(file, 60) == 1
    Heartbeat(file).beat()
    assert check(file, 60) == 0
    long_ago = time.time() - 120
    os.utime(file, (long_ago, long_ago))
    assert check(file, 60) == 1
    Heartbeat(file).beat()
    assert check(file, 60) == 0


def test_an_extractor_beats_in_its_drains(
    catalog: Catalog, store: FolderStore, tmp_path: Path
) -> None:
    settings = Settings(heartbeat_file=tmp_path / "heartbeat")
    worker = ExtractorWorker(catalog, store, settings, "extractor")
    worker.drain(threading.Event())
    worker.close()
    assert seconds_since_heartbeat(tmp_path / "heartbeat") < 60


def test_without_a_heartbeat_file_nothing_is_written(tmp_path: Path) -> None:
    Heartbeat(None).beat()
    assert list(tmp_path.iterdir()) == []
