"""`rerank` and `explain` as a user asks for them: one call, one answer."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.support.photos import near_copy, photo_bytes
from tests.support.server import ServerProcess, environment, run_command

PLACES = range(2000, 2006)


@pytest.fixture(scope="module")
def places(server: ServerProcess) -> list[str]:
    return [server.indexed(photo_bytes(number), f"{number}.jpg") for number in PLACES]


def test_stored_photo_is_answered_in_one_call(server: ServerProcess, places: list[str]) -> None:
    answer = server.similar(places[0], top_k=3, rerank=5, explain="true")
    assert answer.status_code == 200, answer.text
    found = answer.json()["similar_images"]
    scores = [one["rerank_score"] for one in found]
    assert len(found) == 3
    assert scores == sorted(scores, reverse=True)
    assert all(one["explanation"]["overlay"] for one in found)


def test_command_shows_both(server: ServerProcess, places: list[str], tmp_path: Path) -> None:
    photo = tmp_path / "again.jpg"
    photo.write_bytes(near_copy(PLACES[2]))
    requests: list[str | Path] = ["query", photo, "--rerank", "5", "--explain"]
    env = {**environment(server.home), "COLUMNS": "200"}
    shown = run_command(*requests, env=env, cwd=tmp_path)
    assert shown.returncode == 0, shown.stderr
    assert "reranked" in shown.stdout
    assert "8 x 8 patches" in shown.stdout
    answer = json.loads(run_command(*requests, "--json", env=env, cwd=tmp_path).stdout)
    assert answer["similar_images"][0]["image_id"] == places[2]
