"""A model of one's own, by commands and over HTTP: added, used to describe and search, replaced."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.checkpoints import own_output, untrained, write_checkpoint
from tests.support.exported import SIDE, code_name, onnx_of, tiny_network, tiny_torchscript
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


def test_describe_makes_of_a_file_and_of_an_added_model_what_the_model_itself_makes(
    placewise: Commands, tmp_path: Path
) -> None:
    checkpoint = write_checkpoint(tmp_path / "best.ckpt")
    placewise.json("models", "add", checkpoint, "--name", "described")
    photo = tmp_path / "street.jpg"
    photo.write_bytes(photo_bytes(7))
    specs = []
    for name in (f"gsv:{checkpoint}", "gsv:described"):
        out = tmp_path / "rows.npy"
        specs.append(placewise.json("describe", photo, "--extractor", name, "--out", out)["spec"])
        (row,) = np.load(out)
        assert np.allclose(row, own_output(untrained(), photo_bytes(7)), atol=1e-5)
        assert specs[-1].pop("extractor") == name
        assert specs[-1].pop("backbone") == name
    assert specs[0] == specs[1]
    out = tmp_path / "none.npy"
    expected = ("describe", photo, "--extractor", "gsv:nobody", "--out", out)
    assert "model_missing" in placewise.refused(*expected)
    assert not out.exists()


def test_a_checkpoint_that_can_not_be_used_is_one_line(placewise: Commands, tmp_path: Path) -> None:
    bad = tmp_path / "bad.ckpt"
    bad.write_bytes(b"no checkpoint")
    assert "checkpoint_unreadable" in placewise.refused("models", "add", bad, "--name", "bad")
    checkpoint = write_checkpoint(tmp_path / "best.ckpt")
    assert "invalid_field" in placewise.refused("models", "add", checkpoint, "--name", "a/b")


def test_a_map_answers_while_it_changes_from_one_exported_network_to_another(
    tmp_path: Path,
) -> None:
    script = tmp_path / "net.pt"
    script.write_bytes(tiny_torchscript())
    network = tmp_path / "net.onnx"
    network.write_bytes(onnx_of(tiny_network(seed=8), tmp_path))
    home = tmp_path / "home"
    with ServerProcess(home, code_allowed=code_name(script.read_bytes())) as server:
        placewise = Commands(tmp_path, server.home)
        options = ("--options", f"input.size={SIDE}x{SIDE}")
        names = [
            placewise.json("models", "add", file, "--name", name, *options)["result"]["extractor"]
            for file, name in ((script, "first"), (network, "second"))
        ]
        assert [name.partition(":")[0] for name in names] == ["torchscript", "onnx"]
        table = placewise("models", "added").stdout
        assert all(name in table for name in names)
        placewise.json("maps", "switch", "default", "--extractor", names[0])
        for number in range(PHOTOS):
            server.indexed(photo_bytes(number), f"{number}.jpg")
        found: list[str] = []
        done = threading.Event()

        def ask() -> None:
            while not done.is_set() or len(found) < 3:
                answer = server.ask(near_copy(2))
                assert answer.status_code == 200, answer.text
                found.append(answer.json()["similar_images"][0]["original_filename"])

        with ThreadPoolExecutor(1) as asking:
            asked = asking.submit(ask)
            switched = placewise.json("maps", "switch", "default", "--extractor", names[1])
            done.set()
            asked.result()
        assert switched["result"]["failed"] == 0
        assert set(found) == {"2.jpg"}
        answer = server.ask(near_copy(2))
        assert answer.json()["similar_images"][0]["original_filename"] == "2.jpg"
        assert server.client.get("/api/v1/maps/default").json()["extractor"] == names[1]
