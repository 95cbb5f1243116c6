"""`placewise maps`: the labels of a map."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from rich.console import Console

from tests.support.api_responses import JOB, MAP
from tests.support.commands import run, run_json
from tests.support.fake_server import FakeServer, running_server


def test_create_sends_the_options_that_are_given(server: FakeServer) -> None:
    server.will_answer(201, MAP)
    options = ["--place-labels-are-paths", "--rows", "float16", "--matching", "off"]
    options += ["--elsewhere", "0.05"]
    run("maps", "create", "tower", *options, "--server", server.url)
    _, path, body = server.requests[0]
    assert path == "/api/v1/maps"
    assert json.loads(body) == {
        "name": "tower",
        "place_labels_are_paths": True,
        "rows": "float16",
        "matching": "off",
        "elsewhere": 0.05,
    }


def test_matching_on_waits_for_the_local_features_and_says_how_many_there_are(
    server: FakeServer,
) -> None:
    features = {"model": "xfeat@1", "photos": 0, "missing": 3, "bytes": 0, "used": None}
    on = MAP | {"matching": "on", "local_features": features, "model_change_id": JOB["job_id"]}
    features = features | {"photos": 3, "missing": 0, "bytes": 210_000, "used": True}
    done = on | {"local_features": features, "model_change_id": None}
    for answer in (on, JOB, [done]):
        server.will_answer(200, answer)
    result = run("maps", "update", "tower", "--matching", "on", "--server", server.url)
    assert json.loads(server.requests[0][2]) == {"matching": "on"}
    assert server.requests[1][1].startswith(f"/api/v1/jobs/{JOB['job_id']}")
    assert "Map tower: matching on: 3 photos, 0.2 MB, used." in result.output


def test_the_share_of_queries_from_elsewhere_is_changed(server: FakeServer) -> None:
    server.will_answer(200, MAP | {"elsewhere": 0.05})
    result = run("maps", "update", "tower", "--elsewhere", "0.05", "--server", server.url)
    assert json.loads(server.requests[0][2]) == {"elsewhere": 0.05}
    assert "5.0 % from elsewhere" in result.output


def test_update_without_a_change_is_refused() -> None:
    assert run_json("maps", "update", "tower", code=1)["code"] == "no_option"


def test_with_the_settings_of_separate_services_no_server_is_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PLACEWISE_HOME", str(tmp_path))
    monkeypatch.setenv("SEARCH_URLS", "http://127.0.0.1:8100")
    result = run("maps", "list", "--json", code=1)
    problem = json.loads(result.stdout)
    assert problem["code"] == "separate_services"
    assert "PLACEWISE_SERVER" in problem["detail"]
    assert result.stderr == "", "it does not say that it starts one"
    assert not list(tmp_path.iterdir())


def test_list_fits_80_columns_with_whole_headers(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Console(force_terminal=True, color_system=None, width=80)
    monkeypatch.setattr("services.cli.output.console", terminal)
    counts = {"photos": 123_456, "searchable": 123_456, "vocabulary": "provisional"}
    city = MAP | counts | {"name": "city", "dimension": 98_304}
    with running_server() as server:
        server.will_answer(200, [MAP | counts, city])
        result = run("maps", "list", "--server", server.url)
    assert all(len(line) <= 80 for line in result.output.splitlines()), result.output
    headers = ("photos", "searchable", "queries", "extractor", "vocabulary", "dimension")
    for word in (*headers, "123456", "98304"):
        assert word in result.output, word
