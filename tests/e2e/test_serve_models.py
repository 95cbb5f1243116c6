"""A model of one's own, by commands and over HTTP: added, used to describe and search, replaced."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.support.checkpoints import write_checkpoint
from tests.support.photos import near_copy, photo_bytes
from tests.support.problems import problem
from tests.support.server import CommandLine, ServerProcess

PHOTOS = 4


class Commands(CommandLine):
    """`placewise` beside the server, whose answers are JSON."""

    def json(self, *arguments: str | Path) -> Any:
        return self(*arguments, "--json").json()

    def refused(self, *arguments: str | Path) -> str:
        """The line on stderr of a command that ends with 1."""
        run = self(*arguments)
        assert run.code == 1, run.stdout
        return run.stderr


@pytest.fixture
def placewise(server: ServerProcess, tmp_path: Path) -> Commands:
    return Commands(tmp_path, server.home)


def test_a_trained_model_describes_a_map_answers_and_makes_room_again(
    server: ServerProcess, placewise: Commands, tmp_path: Path
) -> None:
    checkpoint = write_checkpoint(tmp_path / "best.ckpt")
    added = placewise.json("models", "add", checkpoint, "--name", "walks", "--licence", "CC BY 4.0")
    assert added["result"]["extractor"] == "gsv:walks"
    (listed,) = placewise.json("models", "added")
    assert (listed["name"], listed["licence"], listed["maps"]) == ("walks", "CC BY 4.0", [])

    for number in range(1, PHOTOS):  # beside the one that the server has
        server.indexed(photo_bytes(number), f"{number}.jpg")
    before = server.client.get("/api/v1/maps/default").json()
    switched = placewise.json("maps", "switch", "default", "--extractor", "gsv:walks")
    assert (switched["result"]["dimension"], switched["result"]["failed"]) == (128, 0)

    answer = server.ask(near_copy(2), top_k=PHOTOS)
    assert answer.status_code == 200, answer.text
    found = answer.json()["similar_images"]
    assert found[0]["original_filename"] == "2.jpg"
    assert answer.json()["vocabulary"] == "none"
    used = server.client.delete("/api/v1/models/walks")
    assert problem(used, 409, "model_in_use")["maps"] == ["default"]
    assert "model_in_use" in placewise.refused("models", "remove", "walks")

    back = placewise.json("maps", "switch", "default", "--extractor", before["extractor"])
    assert back["result"]["dimension"] == before["dimension"]
    assert server.ask(near_copy(2)).json()["similar_images"][0]["original_filename"] == "2.jpg"
    assert placewise.json("models", "remove", "walks")["removed_model"] == "walks"
    assert placewise.json("models", "added") == []
