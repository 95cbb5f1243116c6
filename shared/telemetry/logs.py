"""One format for every line of a process's log: ours, uvicorn's, Celery's.

`text` is for people, `json` one object a line for programs. What a call passes as `extra` becomes
members of the object, or `name=value` behind the message.

Values from callers can neither start a line nor control a terminal: both formats escape control
characters, line breaks of every kind and bidirectional overrides.
"""

from __future__ import annotations

import json
import logging
import re
from datetime import UTC, datetime
from typing import Any

from shared.config.settings import Settings
from shared.telemetry.tracing import current_request_id, current_trace_id

TEXT_FORMAT = "%(asctime)s %(levelname)s %(name)s: %(message)s"
OWN_LOGGERS = ("services", "shared")
# Of others, never each statement, call or message.
QUIET_LOGGERS = ("alembic", "celery", "httpx2", "kombu", "opentelemetry", "sqlalchemy", "urllib3")

# C0 and C1 controls, DEL, Unicode's line breaks and bidirectional controls, halves of characters.
UNSAFE = re.compile("[\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")

# What every record has; the rest came as `extra`. `taskName` is asyncio's.
STANDARD_ATTRIBUTES = frozenset(logging.makeLogRecord({}).__dict__) | {
    "asctime",
    "color_message",  # uvicorn's message once more, for terminals
    "message",
    "request_id",
    "service",
    "taskName",
    "trace_id",
}


class ContextFilter(logging.Filter):
    """Adds to each record the service, the request and the trace that it belongs to."""

    def __init__(self, service: str) -> None:
        super().__init__()
        self._service = service

    def filter(self, record: logging.LogRecord) -> bool:
        record.service = self._service
        # A line that speaks of another request than the one at hand says so itself.
        if not hasattr(record, "request_id"):
            record.request_id = current_request_id()
        record.trace_id = current_trace_id()
        return True


class JsonFormatter(logging.Formatter):
    """One JSON object a line: `time` (UTC), `level`, `logger`, `service`, `message`, then
    `request_id` and `trace_id` where there are any, `error` with a trace, and what came as `extra`.
    """

    def format(self, record: logging.LogRecord) -> str:
        line: dict[str, Any] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname,
            "logger": record.name,
            "service": getattr(record, "service", None),
            "message": record.getMessage(),
        }
        for name in ("request_id", "trace_id"):
            if (value := getattr(record, name, None)) is not None:
                line[name] = value
        line |= _extra(record)
        if record.exc_info:
            line["error"] = self.formatException(record.exc_info)
        text = json.dumps(line, ensure_ascii=False, default=str)
        return UNSAFE.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


class TextFormatter(logging.Formatter):
    """A line for people; the request's id and what came as `extra` stand at its end. The lines of a
    traceback are indented: whatever an error says, no line of it can look like one of the log."""

    def __init__(self) -> None:
        super().__init__(TEXT_FORMAT)

    def format(self, record: logging.LogRecord) -> str:
        line, *trace = super().format(record).split("\n")
        return "\n".join([line, *(f"  {_escaped(one)}" for one in trace)])

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802  (logging's name)
        said = super().formatMessage(record)
        facts = _extra(record)
        if (request_id := getattr(record, "request_id", None)) is not None:
            facts["request_id"] = request_id
        return _escaped(" ".join([said, *(f"{name}={value}" for name, value in facts.items())]))


def _escaped(text: str) -> str:
    """The text with unsafe characters as Python writes them: `\\n`, `\\x1b`, `\\u2028`."""
    return UNSAFE.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def _extra(record: logging.LogRecord) -> dict[str, Any]:
    return {
        name: value for name, value in record.__dict__.items() if name not in STANDARD_ATTRIBUTES
    }


def configure_logging(settings: Settings, service: str) -> None:
    """Every line of this process to stderr, in the format of LOG_FORMAT; ours in detail with DEBUG.
    What was set up before goes."""
    handler = logging.StreamHandler()
    handler.addFilter(ContextFilter(service))
    handler.setFormatter(JsonFormatter() if settings.log_format == "json" else TextFormatter())
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(logging.INFO)
    for name in OWN_LOGGERS:
        logging.getLogger(name).setLevel(logging.DEBUG if settings.debug else logging.INFO)
    for name in QUIET_LOGGERS:
        logging.getLogger(name).setLevel(logging.WARNING)
