"""What a line of the log says, in both formats, whoever writes it."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta

import pytest

from shared.config.settings import Settings
from shared.telemetry.logs import configure_logging
from shared.telemetry.request_ids import request_id_context, request_id_or_new

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
        configure_logging(Settings(), "gateway")

    yield make
    for handler in set(root.handlers) - set(before[0]):
        handler.close()
    root.handlers[:], level, levels = before
    root.setLevel(level)
    for name, was in levels.items():
        logging.getLogger(name).setLevel(was)


def test_json_lines_hold_message_logger_and_request_id(
    set_up: Set, capsys: pytest.CaptureFixture[str]
) -> None:
    set_up(LOG_FORMAT="json")
    with request_id_context("r-1"):
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


def test_text_lines_begin_with_the_time_in_utc_and_end_with_the_fields(
    set_up: Set, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    set_up()
    with monkeypatch.context() as elsewhere:
        elsewhere.setenv("TZ", "Asia/Kolkata")
        time.tzset()
        with request_id_context("r-1"):
            logging.getLogger("services.gateway").info("stored", extra={"status": 202})
    time.tzset()
    logging.getLogger("services.gateway").debug("only with DEBUG")
    (line,) = capsys.readouterr().err.splitlines()
    stamp, _, text = line.partition(" ")
    assert text == "INFO services.gateway: stored status=202 request_id=r-1"
    assert abs(datetime.fromisoformat(stamp) - datetime.now(UTC)) < timedelta(minutes=1)
    set_up(DEBUG="true")
    logging.getLogger("services.gateway").debug("only with DEBUG")
    assert "only with DEBUG" in capsys.readouterr().err


def test_a_terminal_of_the_embedded_server_shows_warnings_and_with_debug_all(
    set_up: Set, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    set_up()
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    configure_logging(Settings(), "embedded", for_operators=False)
    log = logging.getLogger("services.request_log")
    log.info("POST /api/v1/upload: 202")
    log.warning("the disk is full")
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith("the disk is full")
    configure_logging(Settings(debug=True), "embedded", for_operators=False)
    log.info("POST /api/v1/upload: 202")
    assert "POST /api/v1/upload: 202" in capsys.readouterr().err


@pytest.mark.parametrize("log_format", ["text", "json"])
@pytest.mark.parametrize("control", ["\r\n", "\x1b", "\x7f", "\x9f", "\u2028", "\u202e", "\ud800"])
def test_line_breaks_and_control_characters_of_callers_are_escaped(
    set_up: Set, capsys: pytest.CaptureFixture[str], log_format: str, control: str
) -> None:
    forged = "2026-11-21 12:00:00,000 INFO services.request_log: DELETE /api/v1/maps/a: 200"
    reported = f"/a{control}{forged}"
    set_up(LOG_FORMAT=log_format)
    log = logging.getLogger("services.request_log")
    log.info("GET %s: 404", reported, extra={"file": reported})
    try:
        raise ValueError(reported)
    except ValueError:
        log.exception("it failed with %s", reported)
    text = capsys.readouterr().err
    assert all(0x20 <= ord(one) < 0x7F for one in text.replace("\n", ""))
    lines = text.split("\n")
    assert not [line for line in lines if line.startswith(forged)]
    if log_format == "json":
        called, failed, end = lines
        assert (json.loads(called)["file"], end) == (reported, "")
        assert reported in json.loads(failed)["error"]
    else:
        assert lines[0].count("INFO services.request_log") == 3, "in one line"
        assert "  Traceback (most recent call last):" in lines
        assert all(line.startswith("  ") for line in lines[2:-1])


@pytest.mark.parametrize("sent", [None, "", "a b", "a\nb", "x" * 129, "é", "{{7*7}}"])
def test_an_invalid_request_id_is_replaced(sent: str | None) -> None:
    made = request_id_or_new(sent)
    assert made != sent
    assert len(made) == 36
    assert request_id_or_new("my-id:1/2") == "my-id:1/2"
