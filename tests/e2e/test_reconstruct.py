"""`placewise reconstruct` and `export colmap` as a user runs them.

Each test continues the one above.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from shared.geometry.colmap_model import read_colmap_model
from tests.support.reconstructable_server import SCENE, STRAY, reconstructable_server
from tests.support.server import CommandLine, ServerProcess


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServerProcess]:
    """A server with the photos of the scene and a stray one, also in the folder `photos`."""
    with reconstructable_server(tmp_path_factory.mktemp("walk")) as server:
        yield server


def run(server: ServerProcess, *arguments: str | Path, fails: bool = False) -> str:
    """The command's output."""
    shown = CommandLine(server.home.parent, server.home, columns=200)(*arguments)
    assert bool(shown.code) == fails, shown.stdout + shown.stderr
    return shown.stdout + shown.stderr


def result(server: ServerProcess, *arguments: str | Path) -> Any:
    return CommandLine(server.home.parent, server.home)(*arguments, "--json").json()


def test_map_without_a_reconstruction_says_how_to_make_one(walk: ServerProcess) -> None:
    shown = run(walk, "export", "colmap", "--out", "model", fails=True)
    assert "no_reconstruction" in shown
    assert "placewise reconstruct" in shown


def test_command_shows_the_components_and_where_coordinates_disagree(walk: ServerProcess) -> None:
    shown = run(walk, "reconstruct")
    assert f"{SCENE.photos} of {SCENE.photos + 1} photos are in 1 components." in shown
    assert f"No other photo shows the same: {STRAY}" in shown
    assert "m from the coordinates" in shown
    assert "The coordinates of 1 photos disagree with it" in shown


def test_exported_model_is_one_that_can_be_imported(walk: ServerProcess) -> None:
    out = walk.home.parent / "model"
    exported = result(walk, "export", "colmap", "--out", out)
    assert exported == {"folder": str(out), "components": 1, "photos": SCENE.photos}
    model = read_colmap_model(out / "0")
    assert {photo.name for photo in model.photos} == {f"{n}.jpg" for n in range(SCENE.photos)}
    refused = run(walk, "reconstruct", "--import", out, fails=True)
    assert "bad_colmap_model" in refused
    made = result(walk, "reconstruct", "--import", out / "0")
    assert made["imported"]
    assert (made["result"]["reconstructed"], made["result"]["unmatched"]) == (SCENE.photos, 0)
    (stray,) = made["result"]["left_out_photos"]
    assert (stray["name"], stray["reason"]) == (STRAY, "The imported model does not name them")
    assert made["components"][0]["photos"] == SCENE.photos
    refused = run(walk, "reconstruct", "--import", out / "0", "--origin", "45,7", fails=True)
    assert "bad_origin" in refused
    placed = result(walk, "reconstruct", "--import", out / "0", "--origin=-33.9,18.4,25")
    (component,) = placed["components"]
    assert (component["latitude"], component["longitude"]) == (-33.9, 18.4)
    assert component["metres_per_unit"] == 1


@pytest.mark.parametrize(
    "options", [("--origin", "45,7,240"), ("--from-scratch", "--import", "photos")]
)
def test_options_that_contradict_are_refused(walk: ServerProcess, options: tuple[str, ...]) -> None:
    assert "options_contradict" in run(walk, "reconstruct", *options, fails=True)
