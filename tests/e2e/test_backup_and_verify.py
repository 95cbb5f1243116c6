"""Backup, restore, verify, figures and logs of a server that runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tests.support.metrics import read
from tests.support.photos import photo_bytes
from tests.support.server import CommandLine, ServerProcess


def run(server_or_home: Path, *arguments: str | Path, code: int = 0) -> Any:
    return CommandLine(server_or_home.parent, server_or_home)(*arguments, "--json").json(code)


def test_a_running_server_is_backed_up_and_another_one_answers_as_it_did(
    server: ServerProcess, tmp_path: Path
) -> None:
    for number in range(1, 4):
        server.indexed(
            photo_bytes(number), f"{number}.jpg", latitude=45 + number / 100, longitude=7
        )
    out = tmp_path / "backup"
    about = run(server.home, "storage", "backup", out)
    assert about["photos"] == 4
    assert about["missing"] == about["damaged"] == []
    query = photo_bytes(2)
    before = server.ask(query, top_k=3).json()["similar_images"]

    refused = run(server.home, "storage", "restore", out, code=1)
    assert refused["code"] == "home_in_use"
    home = tmp_path / "other"
    restored = run(home, "storage", "restore", out)
    assert restored["objects"] == about["objects"]
    again = run(home, "storage", "restore", out, code=1)
    assert again["code"] == "target_not_empty"
    with ServerProcess(home) as other:
        assert other.ask(query, top_k=3).json()["similar_images"] == before
        assert run(home, "storage", "verify", "--originals")["faults"] == []


def test_one_scrape_of_the_embedded_server_has_metrics_of_all_its_parts(
    server: ServerProcess,
) -> None:
    server.indexed(photo_bytes(20))
    assert server.ask(photo_bytes(21)).is_success
    text = read(server.client.get("/metrics").text)
    assert text["placewise_extractor_jobs_total"][(("kind", "index"), ("outcome", "succeeded"))] > 0
    assert text["placewise_search_searches_total"][(("outcome", "answered"),)] > 0
    assert text["placewise_search_rows"][()] > 0
    assert text["placewise_steward_tasks_total"][(("outcome", "done"), ("task", "reclaim_leases"))]
    assert text["placewise_gateway_catalog_up"][()] == 1


def test_what_is_not_there_can_neither_be_backed_up_nor_verified(tmp_path: Path) -> None:
    for command in (["backup", tmp_path / "out"], ["verify"]):
        refused = run(tmp_path / "home", "storage", *command, code=1)
        assert refused["code"] == "nothing_stored"
    assert not (tmp_path / "out").exists()
    assert (
        run(tmp_path / "home", "storage", "restore", tmp_path / "out", code=1)["code"]
        == "no_backup"
    )
