"""`placewise compare --map`: extractors on a map's own photos, and the command that switches."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.exported import SIDE, tiny_onnx
from tests.support.photos import near_copy, photo_bytes
from tests.support.server import CommandLine, ServerProcess

PLACES = 6
NETWORK = f"input.size={SIDE}x{SIDE}"


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServerProcess]:
    """A map whose places have two photos each, and a labelled query."""
    home = tmp_path_factory.mktemp("town") / "home"
    with ServerProcess(home) as server:
        server.client.patch("/api/v1/maps/default", json={"matching": "off"})
        jobs = []
        for number in range(PLACES):
            place = f"place {number}"
            for data, name, role in (
                (photo_bytes(number), "a", "database"),
                (photo_bytes(number, quality=60), "b", "database"),
                (near_copy(number), "q", "query"),
            ):
                sent = server.upload(data, f"{name}{number}.jpg", place=place, role=role)
                jobs.append(sent.json()["job_id"])
        assert {server.finished(job)["state"] for job in jobs} == {"succeeded"}
        yield server


def test_extractors_are_compared_on_a_map_with_the_command_that_switches_to_the_best(
    town: ServerProcess, tmp_path: Path
) -> None:
    placewise = CommandLine(tmp_path, town.home)
    file = tmp_path / "net.onnx"
    file.write_bytes(tiny_onnx())
    placewise("models", "add", file, "--name", "tiny", "--options", NETWORK, "--json").json()
    own = f"onnx:{file}:{NETWORK}"
    command = ("compare", "--map", "default", "--extractor", own)
    run = placewise(*command, "--extractor", "onnx:nobody", "--json")
    compared = {each["extractor"]: each for each in run.json()}
    assert "onnx:nobody is left out" in run.stderr
    in_use = town.client.get("/api/v1/maps/default").json()["extractor"]
    assert {in_use, "efficientnet-lite0-vlad128", "patchnorm", own} <= compared.keys()
    assert compared[in_use]["switch"] is None
    assert compared[own]["switch"].endswith(f"models add {file} --name NAME")
    tiny = compared[f"onnx:tiny:{NETWORK}"]
    assert tiny["recall_at_1"]["mean"] == compared[own]["recall_at_1"]["mean"]
    for each in compared.values():
        assert each["queries"] == f"{PLACES} labelled queries"
        low, high = each["recall_at_1"]["interval"]
        assert 0 <= low <= each["recall_at_1"]["mean"] <= high <= 1
        assert each["cpu_seconds"] > 0
    assert tiny["recall_at_1"]["mean"] >= 0.5  # near copies are found
    words = shlex.split(tiny["switch"])
    assert words[0] == f"PLACEWISE_HOME={town.home}"
    placewise(*words[2:], "--json").json()
    switched = town.client.get("/api/v1/maps/default").json()["extractor"]
    assert switched == tiny["extractor"]
    table = placewise("compare", "--photos", "20")
    assert table.code == 0, table.stderr
    header, *rows = table.stdout.splitlines()
    assert header.split("\t")[:3] == ["extractor", "R@1", "95 %"]
    names = {row.split("\t")[0] for row in rows if "\t" in row}
    assert names == compared.keys() - {in_use, own}
    assert "best" in rows[-1]


def test_a_map_whose_photos_show_nothing_twice_is_a_clear_error(
    town: ServerProcess, tmp_path: Path
) -> None:
    placewise = CommandLine(tmp_path, town.home)
    placewise("maps", "create", "empty", "--json").json()
    assert "no described photo" in placewise("compare", "--map", "empty", "--json").refusal(
        "nothing_to_evaluate"
    )
    placewise("compare", "--map", "nobody", "--json").refusal("map_not_found")
    elsewhere = CommandLine(tmp_path, tmp_path / "elsewhere")
    assert "PLACEWISE_HOME" in elsewhere("compare", "--json").refusal("map_not_found")
