"""`placewise reconstruct` and `export colmap` as a user runs them.

Each test continues the one above. The photos' local features are those of a made-up scene: their
pixels show none.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from uuid import UUID

import pytest

from shared.catalog.database.session import Catalog
from shared.geometry.colmap_model import read_colmap_model
from shared.storage import FolderStore
from tests.support.local_features import add_features
from tests.support.photos import photo_bytes
from tests.support.poses import ORIGIN, SIMILARITY
from tests.support.reconstructed_scene import ReconstructedScene
from tests.support.server import ServerProcess, environment, run_command

SCENE = ReconstructedScene()
WRONG = 2  # the photo whose latitude is 100 m off
WRONG_DEGREES = 0.001


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServerProcess]:
    """A server with the photos of the scene, which are also in the folder `photos`."""
    folder = tmp_path_factory.mktemp("walk")
    (folder / "photos").mkdir()
    with ServerProcess(folder / "home") as server:
        ids = []
        centres = SIMILARITY.apply(SCENE.component.centres())
        for number, centre in enumerate(centres):
            place = ORIGIN.to_geographic(centre)
            (folder / "photos" / f"{number}.jpg").write_bytes(photo_bytes(number))
            fields = {
                "latitude": place.latitude + (WRONG_DEGREES if number == WRONG else 0),
                "longitude": place.longitude,
                "altitude": place.altitude_m,
            }
            ids.append(UUID(server.indexed(photo_bytes(number), f"{number}.jpg", **fields)))
        server.kill()
        catalog = Catalog(f"sqlite:///{server.home / 'catalog.sqlite'}")
        features = dict(zip(ids, SCENE.features.values(), strict=True))
        add_features(catalog, FolderStore(server.home / "objects"), features)
        catalog.close()
        server.start()
        yield server


def run(server: ServerProcess, *arguments: str | Path, fails: bool = False) -> str:
    """The command's output."""
    env = {**environment(server.home), "COLUMNS": "200"}
    shown = run_command(*arguments, env=env, cwd=server.home.parent)
    assert bool(shown.returncode) == fails, shown.stdout + shown.stderr
    return shown.stdout + shown.stderr


def result(server: ServerProcess, *arguments: str | Path) -> Any:
    env = environment(server.home)
    shown = run_command(*arguments, "--json", env=env, cwd=server.home.parent)
    assert shown.returncode == 0, shown.stderr
    return json.loads(shown.stdout)


def test_map_without_a_reconstruction_says_how_to_make_one(walk: ServerProcess) -> None:
    shown = run(walk, "export", "colmap", "--out", "model", fails=True)
    assert "no_reconstruction" in shown
    assert "placewise reconstruct" in shown


def test_command_shows_the_components_and_where_coordinates_disagree(walk: ServerProcess) -> None:
    shown = run(walk, "reconstruct")
    assert f"{SCENE.photos} of {SCENE.photos} photos are in 1 components." in shown
    assert "m from the coordinates" in shown
    assert "The coordinates of 1 photos disagree with it" in shown


def test_proposals_are_listed_accepted_and_undone(walk: ServerProcess) -> None:
    listed = run(walk, "reconstruct", "--proposals", "list")
    assert f"{WRONG}.jpg" in listed
    assert "Nothing was changed." in listed
    (before,) = result(walk, "reconstruct", "--proposals", "list")
    assert before["latitude"] - before["proposed_latitude"] == pytest.approx(
        WRONG_DEGREES, abs=1e-5
    )
    path = f"/api/v1/uploads/{before['image_id']}"
    run(walk, "reconstruct", "--proposals", "accept")
    assert walk.client.get(path).json()["latitude"] == before["proposed_latitude"]
    assert result(walk, "reconstruct", "--proposals", "list") == []
    assert "No photo has coordinates" in run(walk, "reconstruct", "--proposals", "list")
    run(walk, "reconstruct", "--proposals", "undo")
    assert walk.client.get(path).json()["latitude"] == before["latitude"]
    assert result(walk, "reconstruct", "--proposals", "list") == [before]


def test_exported_model_is_one_that_can_be_imported(walk: ServerProcess) -> None:
    out = walk.home.parent / "model"
    exported = result(walk, "export", "colmap", "--out", out)
    assert exported == {"folder": str(out), "components": 1, "photos": SCENE.photos}
    model = read_colmap_model(out / "0")
    assert {photo.name for photo in model.photos} == {f"{n}.jpg" for n in range(SCENE.photos)}
    refused = run(walk, "reconstruct", "--import", out, fails=True)
    assert "bad_colmap_model" in refused
    photos = walk.home.parent / "photos"
    made = result(walk, "reconstruct", "--import", out / "0", "--images", photos)
    assert made["imported"]
    assert (made["result"]["photos"], made["result"]["unmatched"]) == (SCENE.photos, 0)
    assert made["components"][0]["photos"] == SCENE.photos
    refused = run(walk, "reconstruct", "--import", out / "0", "--origin", "45,7", fails=True)
    assert "bad_origin" in refused
    placed = result(walk, "reconstruct", "--import", out / "0", "--origin=-33.9,18.4,25")
    (component,) = placed["components"]
    assert (component["latitude"], component["longitude"]) == (-33.9, 18.4)
    assert component["metres_per_unit"] == 1


@pytest.mark.parametrize(
    "options",
    [
        ("--images", "photos"),
        ("--origin", "45,7,240"),
        ("--from-scratch", "--import", "photos"),
        ("--proposals", "list", "--from-scratch"),
    ],
)
def test_options_that_contradict_are_refused(walk: ServerProcess, options: tuple[str, ...]) -> None:
    assert "options_contradict" in run(walk, "reconstruct", *options, fails=True)
