"""`placewise vocabulary`: from the photos of a map into a file, and from files into a map."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch

from shared.descriptors.vocabulary_file import read_vocabulary
from tests.support.photos import photo_bytes
from tests.support.server import CommandLine, Run, ServerProcess

SETTINGS = {"extractor": "test-tiny-vlad"}
WIDTH = 16  # of the tiny extractor's local features
PHOTOS = 9


@dataclass(slots=True)
class Folder:
    """A folder in which commands run beside a server whose map has photos."""

    path: Path
    server: ServerProcess

    def run(self, *arguments: str | Path) -> Run:
        return CommandLine(self.path, self.server.home, **SETTINGS)(*arguments)

    def json(self, *arguments: str | Path, code: int = 0) -> Any:
        return self.run("vocabulary", *arguments, "--json").json(code)


@pytest.fixture(scope="module")
def folder(server: ServerProcess, tmp_path_factory: pytest.TempPathFactory) -> Folder:
    for number in range(PHOTOS):
        assert server.upload(photo_bytes(number)).status_code == 202
    return Folder(tmp_path_factory.mktemp("vocabularies"), server)


@pytest.fixture(scope="module")
def fitted(folder: Folder) -> Any:
    """Provenance of the vocabulary that the map's photos give, exported to city.npz."""
    fit = folder.json("fit", "--clusters", "5", "--seed", "3")
    assert (fit["result"]["clusters"], fit["result"]["photos"]) == (5, PHOTOS)
    listed = folder.json("list")[0]
    assert listed["origin"] == "fitted"
    written = folder.json("export", listed["vocabulary_id"], "--out", "city.npz")
    assert (written["file"], written["vocabulary_id"]) == ("city.npz", listed["vocabulary_id"])
    return listed["provenance"]


def test_a_vocabulary_of_a_map_is_exported_with_its_provenance(folder: Folder, fitted: Any) -> None:
    found = read_vocabulary(folder.path / "city.npz")
    assert found.centres.array.shape == (5, WIDTH)
    assert found.provenance == fitted
    assert (fitted["photos"], fitted["patches"], fitted["seed"]) == (PHOTOS, PHOTOS * 64, 3)
    assert (fitted["backbone"], fitted["sha256"]) == ("test-tiny", found.centres.sha256)
    listed = folder.json("list")[0]
    wrong = folder.json("export", listed["vocabulary_id"], "--out", "out.npy", code=1)
    assert wrong["code"] == "bad_out"
    assert folder.run("vocabulary", "export", "../maps", "--out", "a.npz").code == 2, "no ID"


def test_a_map_takes_the_file_and_lists_where_it_comes_from(folder: Folder, fitted: Any) -> None:
    job = folder.json("import", "city.npz")
    assert job["result"]["clusters"] == 5
    listed = folder.json("list")
    assert (listed[0]["origin"], listed[0]["active"]) == ("imported", True)
    assert listed[0]["provenance"] == {**fitted, "imported_from": "city.npz"}
    assert listed[0]["sha256"] == fitted["sha256"]

    torch.save(torch.eye(4, WIDTH), folder.path / "c_centers.pt")
    folder.json("import", "c_centers.pt")
    provenance = folder.json("list")[0]["provenance"]
    assert provenance["learnt_with"] == "unknown"
    assert provenance["imported_from"].startswith("c_centers")
    shown = folder.run("vocabulary", "list").stdout
    for part in ("test-tiny projection square32", "of unknown origin", listed[0]["sha256"][:12]):
        assert part in shown, shown


def test_a_map_is_reduced_by_one_command_and_whole_again_by_another(folder: Folder) -> None:
    folder.json("fit", "--clusters", "8", "--seed", "3")

    def run(*arguments: str) -> str:
        ended = folder.run(*arguments)
        assert ended.code == 0, ended.stderr + ended.stdout
        return " ".join(ended.stdout.split())

    reported = run("maps", "switch", "default", "--pca", "3")
    assert "9 photos, 3 of 128 dimensions with" in reported
    assert "of the variance of 9 rows, 0 failed" in reported
    assert "3 (PCA" in run("maps", "list")
    assert "PCA: 3 of" in run("vocabulary", "list")
    assert "9 photos, 128 dimensions, 0 failed" in run("maps", "switch", "default", "--pca", "0")
    folder.run("maps", "switch", "default", "--pca", "0", "--json").refusal("not_reduced")
