"""`placewise keys`: keys for some maps."""

from __future__ import annotations

from typer.testing import CliRunner

from services.cli.operations.keys import app
from tests.support.api_responses import MAP
from tests.support.fake_server import running_server

CREATE = ("create", "visitor", "--scope", "read", "--map")


def test_a_map_that_does_not_exist_is_refused() -> None:
    with running_server() as server:
        server.will_answer(200, [MAP])
        result = CliRunner().invoke(app, [*CREATE, "tover", "--server", server.url])
    assert "There is no map named 'tover'. The maps are tower." in str(result.exception)
    assert "A key for all maps has no --map." in str(result.exception)
    assert [request[1] for request in server.requests] == ["/api/v1/maps"], "no key is created"
