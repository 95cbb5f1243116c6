"""The catalog removed, or another one: no start; many orphans: none is collected.

tests/contract/storage has the same of a bucket, and of an older catalog. Orphans of any age may be
collected here (ORPHAN_AGE_SECONDS=0), and each start of a server collects at once.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any

import pytest

from shared.config.settings import Settings
from shared.storage import OwnedStore
from shared.storage.keys import ORIGINALS, new_original_key
from shared.storage.open_store import open_store
from tests.support.metrics import read
from tests.support.photos import photo_bytes
from tests.support.server import ServerProcess, environment, run_command
from tests.support.waiting import wait_until

ORPHANS = 101  # more than are collected without asking
PHOTOS = 3
SETTINGS = {"orphan_age_seconds": 0, "auto_evaluate_photos": 0}


@dataclass
class Filled:
    """A home whose server has ended."""

    home: Path

    @property
    def store(self) -> OwnedStore:
        return open_store(Settings(placewise_home=self.home), exclusive=False)

    def originals(self) -> set[str]:
        return {info.key for info in self.store.list(ORIGINALS)}

    def remove_catalog(self) -> None:
        for file in self.home.glob("catalog.sqlite*"):
            file.unlink()

    def server(self, **more: Any) -> ServerProcess:
        return ServerProcess(self.home, **more)

    def command(self, *arguments: str, **more: Any) -> CompletedProcess[str]:
        env = environment(self.home, **SETTINGS, **more)
        return run_command(*arguments, env=env, cwd=self.home.parent)

    def check_refused(self, *arguments: str, **more: Any) -> None:
        done = self.command(*arguments, **more)
        assert done.returncode == 1, done.stderr
        assert "folder_taken" in done.stderr
        assert "placewise storage rebuild" in done.stderr


@pytest.fixture(scope="module")
def filled_once(tmp_path_factory: pytest.TempPathFactory) -> Filled:
    filled = Filled(tmp_path_factory.mktemp("filled") / "home")
    with filled.server() as running:
        for number in range(PHOTOS):
            photo = {"file": ("photo.jpg", photo_bytes(number))}
            assert running.client.post("/api/v1/upload", files=photo).status_code == 202
        wait_until(lambda: _searchable(running) == PHOTOS)
        assert running.stop() == 0
    assert len(filled.originals()) == PHOTOS
    return filled


@pytest.fixture
def filled(filled_once: Filled, tmp_path: Path) -> Filled:
    """A copy, for a test that changes it."""
    home = tmp_path / "copied"
    shutil.copytree(filled_once.home, home)
    return Filled(home)


def _searchable(running: ServerProcess) -> int:
    (found,) = running.client.get("/api/v1/maps").json()
    return int(found["searchable"])


def _figures(running: ServerProcess) -> dict[str, dict[tuple[tuple[str, str], ...], float]]:
    return read(running.client.get("/metrics").text)


def _wait_for_collection(running: ServerProcess) -> None:
    done = (("outcome", "done"), ("task", "collect_orphans"))
    wait_until(lambda: _figures(running).get("placewise_steward_tasks_total", {}).get(done, 0) >= 1)


def test_wrong_catalog_stops_every_start_and_no_object_is_touched(
    filled: Filled, migrated_sqlite: Path, tmp_path: Path
) -> None:
    before = {info.key for info in filled.store.list("")}
    wrong = shutil.copy(migrated_sqlite, tmp_path / "wrong.sqlite")
    for command in (("serve",), ("steward",), ("storage", "verify")):
        filled.check_refused(
            *command,
            database_url=f"sqlite:///{wrong}",
            redis_url="redis://127.0.0.1:1/0",
            **({} if command == ("serve",) else {"search_urls": "http://127.0.0.1:1"}),
        )
    assert {info.key for info in filled.store.list("")} == before


def test_a_removed_catalog_stops_every_start_and_no_object_is_touched(filled: Filled) -> None:
    before = {info.key for info in filled.store.list("")}
    filled.remove_catalog()
    filled.check_refused("serve")
    assert not (filled.home / "catalog.sqlite").exists(), "a restored file would meet it"
    assert {info.key for info in filled.store.list("")} == before


def test_many_orphans_are_held_until_their_collection_is_confirmed(filled: Filled) -> None:
    def run(*arguments: str) -> Any:
        return json.loads(filled.command(*arguments, "--json").stdout)

    originals, orphans = filled.originals(), {new_original_key() for _ in range(ORPHANS)}
    for key in orphans:
        filled.store.put(key, b"orphan")
    with filled.server(**SETTINGS) as running:
        _wait_for_collection(running)
        assert _figures(running)["placewise_steward_collection_held"] == {(): 1}
        (found,) = [one for one in run("doctor") if one["part"] == "server object store"]
        assert not found["ok"]
        assert "storage collect" in found["detail"]
        listed = run("storage", "collect")
        assert (listed["moved"], listed["held"]) == (0, True)
        assert listed["unknown"]["originals/"]["objects"] == ORPHANS
        assert filled.originals() == originals | orphans
        assert run("storage", "collect", "--confirm")["moved"] == ORPHANS
        assert filled.originals() == originals
        assert run("storage", "verify")["trash_objects"] == ORPHANS
        back = run("storage", "restore-trash")
        assert back == {"restored": ORPHANS, "kept_in_trash": 0}
    assert filled.originals() == originals | orphans
