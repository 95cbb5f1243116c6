"""`placewise immich` as a user runs it: a server, and a stand-in for Immich."""

from __future__ import annotations

import json
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest

from placewise.client import Client
from tests.support.immich_server import KEY, NOON, ImmichServer, running_immich, time_text
from tests.support.photos import near_copy, photo_bytes
from tests.support.processes import PLACEWISE, Process, start
from tests.support.server import ServerProcess, environment, run_command

DEGREES_APART = 0.0005
LONGITUDE = 7.0
LOCATED = 10
UNLOCATED = (3, 6, 9)


def position(number: int) -> tuple[float, float]:
    return number * DEGREES_APART, LONGITUDE


class Walk:
    """Photos of a camera in Immich with coordinates, and three between them without."""

    def __init__(self, immich: ImmichServer, server: ServerProcess, folder: Path) -> None:
        self.immich, self.home, self.folder = immich, server.home, folder
        self.map = folder.name.replace("_", "-")[:40]
        self.client = Client(str(server.client.base_url), map=self.map, key=server_key(server))
        self.client.create_map(self.map)
        self.located = {
            number: immich.add(
                f"IMG_{2 * number}.jpg", photo_bytes(number), position(number), 60 * number, "Trip"
            )
            for number in range(1, LOCATED + 1)
        }
        self.unlocated = {
            number: immich.add(
                f"IMG_{2 * number + 1}.jpg", near_copy(number), None, 60 * number + 5, "Trip"
            )
            for number in UNLOCATED
        }

    def start(self, *options: str, **streams: Any) -> Process:
        command = [PLACEWISE, *self.arguments(*options)]
        return start(command, env=self.environment(), cwd=self.folder, **streams)

    def run(self, *options: str, code: int = 0) -> str:
        run = run_command(*self.arguments(*options), env=self.environment(), cwd=self.folder)
        assert run.returncode == code, run.stderr
        return run.stdout if "--json" in options else run.stdout + run.stderr

    def indexed(self) -> dict[str, Any]:
        counts: dict[str, Any] = json.loads(self.run("--json"))["indexed"]
        return counts

    def arguments(self, *options: str) -> list[str]:
        return ["immich", "--url", self.immich.url, "--map", self.map, "--accept", "0.5", *options]

    def environment(self) -> dict[str, str]:
        return {**environment(self.home), "IMMICH_API_KEY": KEY}

    def positions(self) -> list[tuple[float | None, float | None]]:
        return [self.immich.position(each) for each in self.unlocated.values()]


def server_key(server: ServerProcess) -> str | None:
    authorization = server.client.headers.get("Authorization")
    return authorization.removeprefix("Bearer ") if authorization else None


@pytest.fixture
def walk(server: ServerProcess, tmp_path: Path) -> Iterator[Walk]:
    with running_immich() as immich:
        made = Walk(immich, server, tmp_path)
        with made.client:
            yield made


def test_photos_are_indexed_and_proposed_and_immich_is_changed_only_with_write(walk: Walk) -> None:
    report = json.loads(walk.run("--json"))
    assert report["indexed"] == {
        "with_coordinates": LOCATED, "indexed": LOCATED, "changed": 0, "removed": 0,
        "searchable": LOCATED, "failed": [],
    }  # fmt: skip
    assert walk.immich.updates == []
    proposals = {each["filename"]: each for each in report["proposals"]}
    assert proposals.keys() == {f"Trip/IMG_{2 * number + 1}.jpg" for number in UNLOCATED}
    for number in UNLOCATED:
        proposal = proposals[f"Trip/IMG_{2 * number + 1}.jpg"]
        assert proposal["accepted"]
        assert proposal["position"]["latitude"] == pytest.approx(position(number)[0], abs=3e-4)
        looks, taken = proposal["position"]["reason"].split("; ")
        assert looks.startswith("looks like Trip/IMG_")
        assert taken == f"taken 5 s after Trip/IMG_{2 * number}.jpg"
    written = walk.run("--write")
    assert "3 photos written" in written
    assert f"Undo: PLACEWISE_HOME={walk.home} " in written
    assert None not in sum(walk.positions(), ())
    undone = walk.run("--undo")
    assert "3 photos had none. Immich's API can't take coordinates away" in undone
    assert walk.positions() == [(0.0, 0.0)] * 3


def test_the_map_follows_what_was_changed_or_deleted_and_not_what_was_hidden_for_a_moment(
    walk: Walk,
) -> None:
    walk.run("--no-picture")
    fetched = walk.immich.calls["GET /api/assets/{id}"]
    assert walk.indexed()["indexed"] == 0
    assert walk.immich.calls["GET /api/assets/{id}"] - fetched == len(UNLOCATED), "searched ones"
    moved, replaced, deleted, cleared = (walk.located[number] for number in (1, 2, 4, 5))
    walk.immich.move(moved, 1.5, 8.0)
    walk.immich.pictures[replaced] = photo_bytes(77)
    walk.immich.assets[replaced]["checksum"] = "another"
    walk.immich.delete(deleted)
    walk.immich.move(cleared, 0.0, 0.0)
    walk.immich.add("IMG_99.jpg", photo_bytes(50), position(50))
    counts = walk.indexed()
    assert (counts["indexed"], counts["changed"], counts["removed"]) == (2, 1, 2)
    photos = {photo.relative_path: photo for photo in walk.client.photos()}
    assert len(photos) == counts["searchable"] == LOCATED - 1
    assert "Trip/IMG_8.jpg" not in photos
    assert "Trip/IMG_10.jpg" not in photos
    assert (photos["Trip/IMG_2.jpg"].latitude, photos["Trip/IMG_2.jpg"].longitude) == (1.5, 8.0)
    assert walk.client.image(photos["Trip/IMG_4.jpg"].image_id) == photo_bytes(77)
    walk.immich.assets[moved]["originalFileName"] = "renamed.jpg"
    walk.immich.assets[replaced]["fileModifiedAt"] = time_text(NOON + timedelta(days=1))
    counts = walk.indexed()
    assert (counts["changed"], counts["indexed"], counts["searchable"]) == (1, 1, LOCATED - 1)
    assert "Trip/renamed.jpg" in {photo.relative_path for photo in walk.client.photos()}
    # A photo that others move in the listing is not removed.
    hidden = walk.located[7]
    asset = walk.immich.assets.pop(hidden)
    searches: list[str] = []

    def show_again(method: str, path: str) -> None:
        searches.append(path)
        if searches.count("/api/search/metadata") == 3:  # those of the second listing
            walk.immich.assets[hidden] = asset

    walk.immich.before = show_again
    assert json.loads(walk.run("--json", "--no-picture"))["indexed"]["removed"] == 0


def test_a_command_that_is_killed_in_the_middle_is_continued_and_undone(walk: Walk) -> None:
    processes: list[Process] = []

    def kill_at(call: str, number: int) -> None:
        def kill(method: str, path: str) -> None:
            if walk.immich.calls[call] >= number and processes:
                processes.pop().kill()

        walk.immich.before = kill

    for call, number, options in (
        ("GET /api/assets/{id}", 5, ()),  # while it indexes
        ("PUT /api/assets", 2, ("--write",)),
    ):
        walk.immich.calls.clear()
        with (walk.folder / "log").open("wb") as log:
            kill_at(call, number)
            process = walk.start(*options, stdout=log, stderr=log)
            processes.append(process)
            assert process.wait(120) != 0
        assert not processes, "it was killed"
    walk.immich.before = lambda method, path: None
    assert sum(position != (None, None) for position in walk.positions()) < 3
    walk.run("--write")
    assert (None, None) not in walk.positions()
    walk.immich.move(walk.unlocated[3], 45.0, 8.0)
    undone = walk.run("--undo", code=1)
    assert "changed since Trip/IMG_7.jpg: left as it is" in undone
    assert walk.positions() == [(45.0, 8.0), (0.0, 0.0), (0.0, 0.0)]


def test_a_missing_key_permission_or_preview_is_named_and_nothing_is_changed(walk: Walk) -> None:
    env = {**walk.environment(), "IMMICH_API_KEY": ""}
    run = run_command(*walk.arguments(), env=env, cwd=walk.folder)
    assert (run.returncode, "immich_key_missing" in run.stderr) == (1, True)
    walk.immich.permissions.remove("asset.update")
    walk.immich.pictures[walk.unlocated[9]] = b""  # a photo without a preview stops no other
    written = walk.run("--write", code=1)
    assert "Immich answers 404 to GET" in written
    assert written.count("looks like") == 2
    assert "Missing required permission: asset.update" in written
    walk.immich.permissions.remove("asset.read")
    assert "Missing required permission: asset.read" in walk.run(code=1)
    assert walk.immich.updates == []
    assert len(list(walk.client.photos())) == LOCATED


def test_the_job_of_a_server_follows_immich_and_names_its_error(tmp_path: Path) -> None:
    with running_immich() as immich:
        settings = {"immich_url": immich.url, "immich_api_key": KEY}
        with ServerProcess(tmp_path / "home", **settings) as server:
            walk = Walk(immich, server, tmp_path)
            with walk.client as client:
                job = client.wait(client.sync_library(every_hours=24))
                assert job.kind == "sync_library"
                assert job.result == {
                    "with_coordinates": LOCATED, "indexed": LOCATED, "changed": 0, "removed": 0,
                    "searchable": LOCATED, "failed": [], "without_coordinates": 3, "located": 3,
                    "every_hours": 24,
                }  # fmt: skip
                assert immich.updates == []
                immich.permissions.remove("asset.read")
                again = client.sync_library()
                assert again.job_id == job.job_id, "a map has one"
                *_, failed = client.watch(again)
                assert failed.state == "failed"
                assert failed.error is not None
                assert failed.error["code"] == "immich_refused"
                assert "asset.read" in failed.failure
                assert failed.result == job.result, "the counts of the last run that succeeded"
