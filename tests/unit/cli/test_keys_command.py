"""`placewise keys`: keys for some maps."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from services.cli.operations.keys import app
from shared.catalog.database.schema import migrate
from shared.catalog.database.session import Catalog
from tests.support.api_responses import MAP
from tests.support.catalog_rows import add_map
from tests.support.fake_server import running_server

CREATE = ("create", "visitor", "--scope", "read", "--map")


def test_a_map_that_does_not_exist_is_refused_by_a_servers_list_of_maps() -> None:
    with running_server() as server:
        server.will_answer(200, [MAP])
        result = CliRunner().invoke(app, [*CREATE, "tover", "--server", server.url])
    assert "There is no map named 'tover'. The maps are tower." in str(result.exception)
    assert "A key for all maps has no --map." in str(result.exception)
    assert [request[1] for request in server.requests] == ["/api/v1/maps"], "no key is created"


def test_a_map_that_does_not_exist_is_refused_by_the_catalog(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PLACEWISE_HOME", str(tmp_path))
    catalog = Catalog(f"sqlite:///{tmp_path / 'catalog.sqlite'}")
    migrate(catalog)
    with catalog.write() as session:
        add_map(session, "tower")
    catalog.close()
    result = CliRunner().invoke(app, [*CREATE, "tower", "--map", "tover"])
    assert "There is no map named 'tover'" in str(result.exception)
    assert CliRunner().invoke(app, ["list", "--json"]).output.strip() == "[]"
    assert CliRunner().invoke(app, [*CREATE, "tower"]).exit_code == 0
    [key] = json.loads(CliRunner().invoke(app, ["list", "--json"]).output)
    assert key["maps"] == ["tower"]
