"""A map whose photos a torch.hub entry describes; code that nobody allowed is not executed."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.hub import write_hub
from tests.support.photos import near_copy, photo_bytes
from tests.support.problems import field_refused
from tests.support.server import ServerProcess

MAPS = "/api/v1/maps"
PHOTOS = 5


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_hub(tmp_path_factory.mktemp("hub") / "places")


@pytest.fixture(scope="module")
def allowed(folder: Path) -> str:
    return f"torchhub:{folder}:colours:dimension=40,input.size=64x64"


@pytest.fixture(scope="module")
def server(
    tmp_path_factory: pytest.TempPathFactory, folder: Path, allowed: str
) -> Iterator[ServerProcess]:
    spelled_otherwise = allowed.replace("64x64", "064x64")
    both = f"{spelled_otherwise} torchhub:{folder}:maps"
    home = tmp_path_factory.mktemp("server") / "home"
    with ServerProcess(home, code_allowed=both) as started:
        yield started


def make(server: ServerProcess, name: str, extractor: str) -> None:
    answer = server.client.post(MAPS, json={"name": name, "extractor": extractor})
    assert answer.status_code == 201, answer.text


def test_photos_described_by_an_allowed_entry_are_found(
    server: ServerProcess, allowed: str
) -> None:
    make(server, "hub", allowed)
    ids = []
    for number in range(PHOTOS):
        answer = server.client.post(
            "/api/v1/upload",
            params={"map": "hub"},
            files={"file": ("photo.jpg", photo_bytes(number))},
            headers={"Prefer": "wait=30"},
        )
        assert answer.status_code == 201, answer.text
        ids.append(answer.json()["file_id"])
    answer = server.ask(near_copy(3), map="hub", top_k=PHOTOS)
    assert answer.status_code == 200, answer.text
    found = answer.json()
    assert found["similar_images"][0]["image_id"] == ids[3]
    assert found["total_similar"] == PHOTOS
    assert found["vocabulary"] == "none"
    (generation,) = server.client.get("/api/v1/generations", params={"map": "hub"}).json()
    assert generation["dimension"] == 40
    assert generation["extractor"] == allowed
    assert server.client.get(f"{MAPS}/hub").json()["extractor"] == allowed


@pytest.mark.parametrize("entry", ["prints", "colours:dimension=41,input.size=64x64"])
def test_an_entry_that_is_not_allowed_by_its_exact_name_is_refused(
    server: ServerProcess, folder: Path, entry: str
) -> None:
    params = {"name": "other", "extractor": f"torchhub:{folder}:{entry}"}
    answer = server.client.post(MAPS, json=params)
    field_refused(answer, "extractor")
    assert "CODE_ALLOWED" in answer.json()["detail"]
