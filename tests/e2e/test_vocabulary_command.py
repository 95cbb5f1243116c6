"""`placewise vocabulary fit DIR` and back: a vocabulary from a folder into a map."""

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
    """Photos in a folder, one of which no one can decode, and commands that run beside it."""

    path: Path
    server: ServerProcess

    def run(self, *arguments: str | Path) -> Run:
        return CommandLine(self.path, self.server.home, **SETTINGS)(*arguments)

    def json(self, *arguments: str | Path, code: int = 0) -> Any:
        return self.run("vocabulary", *arguments, "--json").json(code)


@pytest.fixture(scope="module")
def folder(server: ServerProcess, tmp_path_factory: pytest.TempPathFactory) -> Folder:
    path = tmp_path_factory.mktemp("vocabularies")
    (path / "photos" / "below").mkdir(parents=True)
    for number in range(PHOTOS):
        name = f"below/{number}.jpg" if number % 2 else f"{number}.jpg"
        (path / "photos" / name).write_bytes(photo_bytes(number))
    (path / "photos" / "broken.jpg").write_bytes(b"\xff\xd8\xff no photo")
    assert server.upload(photo_bytes(100)).status_code == 202
    return Folder(path, server)


@pytest.fixture(scope="module")
def fitted(folder: Folder) -> Any:
    """The output of `vocabulary fit photos --out city.npz`."""
    return folder.json("fit", "photos", "--out", "city.npz", "--clusters", "5", "--seed", "3")


def test_a_folders_vocabulary_is_written_with_its_provenance(folder: Folder, fitted: Any) -> None:
    found = read_vocabulary(folder.path / "city.npz")
    assert (fitted["file"], fitted["clusters"], fitted["dimension"]) == ("city.npz", 5, WIDTH)
    assert found.centres.array.shape == (5, WIDTH)
    assert found.provenance == fitted["provenance"]
    reported = found.provenance
    assert (reported["photos"], reported["patches"], reported["seed"]) == (PHOTOS, PHOTOS * 64, 3)
    assert (reported["backbone"], reported["sha256"]) == ("test-tiny", found.centres.sha256)
    (refused,) = fitted["refused"]
    assert refused["path"] == "photos/broken.jpg"
    assert "decoded" in refused["reason"]


def test_the_same_fit_gives_the_same_file_and_fewer_photos_another(
    folder: Folder, fitted: Any
) -> None:
    common = ("fit", "photos", "--clusters", "5", "--seed", "3")
    again = folder.run("vocabulary", *common, "--out", "again.npz")
    assert again.code == 0, again.stderr
    assert "5 clusters of 16 dimensions from 9 photos, mean cosine 0." in again.stdout
    assert "broken.jpg" in again.stderr
    written = (folder.path / "again.npz").read_bytes()
    assert written == (folder.path / "city.npz").read_bytes()
    fewer = folder.json(*common, "--out", "fewer.npz", "--sample", "6")
    assert fewer["provenance"]["photos"] <= 6
    assert fewer["provenance"]["sha256"] != fitted["provenance"]["sha256"]


def test_a_map_takes_the_file_and_lists_where_it_comes_from(folder: Folder, fitted: Any) -> None:
    job = folder.json("import", "city.npz")
    assert job["result"]["clusters"] == 5
    listed = folder.json("list")
    assert (listed[0]["origin"], listed[0]["active"]) == ("imported", True)
    assert listed[0]["provenance"] == {**fitted["provenance"], "imported_from": "city.npz"}
    assert listed[0]["sha256"] == fitted["provenance"]["sha256"]

    torch.save(torch.eye(4, WIDTH), folder.path / "c_centers.pt")
    folder.json("import", "c_centers.pt")
    provenance = folder.json("list")[0]["provenance"]
    assert provenance["learnt_with"] == "unknown"
    assert provenance["imported_from"].startswith("c_centers")
    shown = folder.run("vocabulary", "list").stdout
    for part in ("test-tiny projection square32", "of unknown origin", listed[0]["sha256"][:12]):
        assert part in shown, shown


def test_a_vocabulary_of_a_map_is_exported_as_a_file_that_a_map_takes(
    folder: Folder, fitted: Any
) -> None:
    folder.json("import", "city.npz")
    listed = folder.json("list")[0]
    written = folder.json("export", listed["vocabulary_id"], "--out", "out.npz")
    assert (written["file"], written["vocabulary_id"]) == ("out.npz", listed["vocabulary_id"])
    found = read_vocabulary(folder.path / "out.npz")
    assert found.provenance == {**fitted["provenance"], "imported_from": "city.npz"}
    assert found.centres.sha256 == fitted["provenance"]["sha256"]
    wrong = folder.json("export", listed["vocabulary_id"], "--out", "out.npy", code=1)
    assert wrong["code"] == "bad_out"
    assert folder.run("vocabulary", "export", "../maps", "--out", "a.npz").code == 2, "no ID"


def test_a_map_is_reduced_by_one_command_and_whole_again_by_another(folder: Folder) -> None:
    for number in range(101, 107):
        assert folder.server.upload(photo_bytes(number)).status_code == 202
    fit = folder.json("fit", "--clusters", "8", "--seed", "3")
    assert (fit["result"]["clusters"], fit["result"]["photos"]) == (8, 7)
    assert folder.json("list")[0]["origin"] == "fitted"

    def run(*arguments: str) -> str:
        ended = folder.run(*arguments)
        assert ended.code == 0, ended.stderr + ended.stdout
        return " ".join(ended.stdout.split())

    reported = run("maps", "switch", "default", "--pca", "3")
    assert "7 photos, 3 of 128 dimensions with" in reported
    assert "of the variance of 7 rows, 0 failed" in reported
    assert "3 (PCA" in run("maps", "list")
    assert "PCA: 3 of" in run("vocabulary", "list")
    assert "7 photos, 128 dimensions, 0 failed" in run("maps", "switch", "default", "--pca", "0")
    folder.run("maps", "switch", "default", "--pca", "0", "--json").refusal("not_reduced")


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("fit", "photos"), "bad_out", "--out FILE.npz"),
        (("fit", "photos", "--out", "city.npy"), "bad_out", ".npz"),
        (("fit", "photos", "--out", "a.npz", "--map", "b"), "options_contradict", "--map"),
        (("fit", "--out", "a.npz"), "options_contradict", "--out"),
        (
            ("fit", "photos", "--out", "a.npz", "--extractor", "test-tiny-avg"),
            "vocabulary_unusable",
            "does not use a vocabulary",
        ),
    ],
)
def test_a_fit_that_can_not_be_is_refused_before_it_begins(
    folder: Folder, arguments: tuple[str, ...], code: str, message: str
) -> None:
    assert message in folder.run("vocabulary", *arguments, "--json").refusal(code)
    assert not (folder.path / "a.npz").exists()
