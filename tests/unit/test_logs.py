"""What a line of the log says, in both formats, whoever writes it."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterator

import pytest

from shared.settings import Settings
from shared.telemetry.logs import set_up_logs
from shared.telemetry.request_id import accept_request_id, under_request_id

Set = Callable[..., None]


@pytest.fixture
def set_up(monkeypatch: pytest.MonkeyPatch) -> Iterator[Set]:
    """Sets up logs as a service does; all is as before in the end."""
    root = logging.getLogger()
    names = ("services", "shared", "celery", "uvicorn.error")
    before = (root.handlers[:], root.level, {n: logging.getLogger(n).level for n in names})

    def make(**variables: str) -> None:
        for name, value in variables.items():
            monkeypatch.setenv(name, value)
        set_up_logs(Settings(), "gateway")

    yield make
    root.handlers[:], level, levels = before
    root.setLevel(level)
    for name, was in levels.items():
        logging.getLogger(name).setLevel(was)


def test_json_lines_hold_what_was_said_by_whom_and_for_which_request(
    set_up: Set, capsys: pytest.CaptureFixture[str]
) -> None:
    set_up(LOG_FORMAT="json")
    with under_request_id("r-1"):
        logging.getLogger("services.gateway").info("stored %s", "a\nb", extra={"jobs": [1, 2]})
    logging.getLogger("uvicorn.error").warning("uvicorn's own")
    logging.getLogger("celery.worker").warning("celery's own")
    logging.getLogger("celery.worker").info("not this one")
    try:
        raise ValueError("why")
    except ValueError:
        logging.getLogger("shared").exception("it failed")
    lines = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    assert [line["message"] for line in lines] == [
        "stored a\nb",
        "uvicorn's own",
        "celery's own",
        "it failed",
    ]
    first = lines[0]
    assert first.pop("time").endswith("+00:00")
    assert first == {
        "level": "INFO",
        "logger": "services.gateway",
        "service": "gateway",
        "message": "stored a\nb",
        "request_id": "r-1",
        "jobs": [1, 2],
    }
    assert "request_id" not in lines[1]
    assert "ValueError: why" in lines[3]["error"]


def test_text_lines_end_with_the_facts(set_up: Set, capsys: pytest.CaptureFixture[str]) -> None:
    set_up()
    with under_request_id("r-1"):
        logging.getLogger("services.gateway").info("stored", extra={"status": 202})
    logging.getLogger("services.gateway").debug("only with DEBUG")
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith("INFO services.gateway: stored status=202 request_id=r-1")
    set_up(DEBUG="true")
    logging.getLogger("services.gateway").debug("only with DEBUG")
    assert "only with DEBUG" in capsys.readouterr().err


@pytest.mark.parametrize("sent", [None, "", "a b", "a\nb", "x" * 129, "é", "{{7*7}}"])
def test_an_id_that_no_header_or_log_should_hold_is_replaced(sent: str | None) -> None:
    made = accept_request_id(sent)
    assert made != sent
    assert len(made) == 36
    assert accept_request_id("my-id:1/2") == "my-id:1/2"
