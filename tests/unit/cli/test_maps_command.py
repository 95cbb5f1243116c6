"""`placewise maps`: the labels of a map."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from services.cli.maps import app
from shared.errors import Misconfigured
from tests.support.api_responses import TIME
from tests.unit.client.test_client import running_server

MAP: dict[str, Any] = {
    "name": "tower",
    "extractor": "efficientnet-lite0-vlad128",
    "version": 0,
    "photos": 0,
    "searchable": 0,
    "labelled_queries": 0,
    "counted_at": TIME,
    "generation_id": None,
    "vocabulary": None,
    "dimension": None,
    "pca_from": None,
    "place_labels_are_paths": True,
    "rows": "float16",
    "created_at": TIME,
}


def test_create_makes_a_map_whose_labels_are_paths() -> None:
    with running_server() as server:
        server.will_answer(201, MAP)
        arguments = ["create", "tower", "--place-labels-are-paths", "--server", server.url]
        result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    _, path, body = server.requests[0]
    assert path == "/api/v1/maps"
    assert json.loads(body) == {"name": "tower", "place_labels_are_paths": True}


def test_create_makes_a_map_with_rows_in_half_precision() -> None:
    with running_server() as server:
        server.will_answer(201, MAP)
        arguments = ["create", "tower", "--rows", "float16", "--server", server.url]
        result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    _, _, body = server.requests[0]
    assert json.loads(body) == {"name": "tower", "rows": "float16"}


def test_with_the_settings_of_separate_services_no_server_is_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PLACEWISE_HOME", str(tmp_path))
    monkeypatch.setenv("SEARCH_URLS", "http://127.0.0.1:8100")
    result = CliRunner().invoke(app, ["list"])
    assert isinstance(result.exception, Misconfigured)
    assert result.exception.code == "separate_services"
    assert "PLACEWISE_SERVER" in result.exception.detail
    assert result.output == "", "it does not say that it starts one"
    assert not list(tmp_path.iterdir())


def test_list_says_whose_labels_are_paths_and_how_rows_are_stored() -> None:
    with running_server() as server:
        server.will_answer(200, [MAP, MAP | {"name": "city", "place_labels_are_paths": False}])
        result = CliRunner().invoke(app, ["list", "--server", server.url])
    assert result.exit_code == 0, result.output
    head, *rows = (line.split("\t") for line in result.output.splitlines())
    listed = [dict(zip(head, row, strict=True)) for row in rows]
    assert [(each["map"], each["labels"], each["rows"]) for each in listed] == [
        ("tower", "paths", "float16"),
        ("city", "names", "float16"),
    ]
