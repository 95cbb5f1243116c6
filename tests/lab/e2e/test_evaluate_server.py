"""`placewise evaluate --data DIR --server URL`: a data set evaluated with a running service."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lab.city.plan import CityOptions, make_plan
from lab.city.write import write_city
from shared.config.embedded_home import server_address_file
from tests.support.server import ServerProcess, environment, run_command


@pytest.fixture(scope="module")
def city(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight photos of four places, one of them there twice, and three queries."""
    out = tmp_path_factory.mktemp("city") / "town"
    write_city(make_plan(CityOptions(4, 2, 3, 0, 0, 0.0, 64, 64, False)), out)
    photos = sorted((out / "database").iterdir())
    twin = photos[-1].with_name(photos[-1].name.replace("@.jpg", "twin@.jpg"))
    twin.write_bytes(photos[-1].read_bytes())
    return out


def run(server: ServerProcess, folder: Path, *arguments: str | Path, code: int = 0) -> Any:
    env = environment(folder / "home")  # not the server's own folder
    ended = run_command("evaluate", *arguments, "--json", env=env, cwd=folder)
    assert ended.returncode == code, ended.stderr + ended.stdout
    return json.loads(ended.stdout)


def test_service_finds_what_the_extractor_finds(
    server: ServerProcess, city: Path, tmp_path: Path
) -> None:
    body = json.loads(server_address_file(server.home).read_text())
    there = ["--server", body["url"], *(["--key", body["key"]] if "key" in body else [])]
    served = run(server, tmp_path, "--data", city, *there, "--out", tmp_path / "served")
    alone = run(
        server, tmp_path, "--data", city, "--extractor", "test-tiny-avg",
        "--out", tmp_path / "alone", "--against", tmp_path / "served",
    )  # fmt: skip
    assert served["recall"] == alone["recall"]
    assert served["run"]["name"] == "map evaluate-town"
    rankings = [np.load(tmp_path / run / "predictions_town.npy") for run in ("served", "alone")]
    assert rankings[0].tolist() == rankings[1].tolist()
    assert (alone["against"]["won"], alone["against"]["lost"]) == ([], [])

    again = run(server, tmp_path, "--data", city, *there)
    assert again["recall"] == served["recall"]
    stats = server.client.get("/api/v1/database/stats", params={"map": "evaluate-town"}).json()
    assert stats["total_images"] == 8, "the twins are one photo"

    (tmp_path / "more.jpg").write_bytes(sorted((city / "queries").iterdir())[0].read_bytes())
    with (tmp_path / "more.jpg").open("rb") as photo:
        uploaded = server.client.post(
            "/api/v1/upload", params={"map": "evaluate-town"}, files={"file": photo}
        )
    assert uploaded.status_code == 202, uploaded.text
    problem = run(server, tmp_path, "--data", city, *there, code=1)
    assert problem["code"] == "map_holds_others"
