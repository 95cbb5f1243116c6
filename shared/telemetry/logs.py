"""Log configuration: one format for all lines of a process, also those of uvicorn and Celery.

`text` is for people, `json` writes one object per line. Values passed as `extra` become members of
the object, or are appended to the message as `name=value`.

Log injection: values from clients can neither start a new line nor control a terminal. Both formats
escape control characters, line breaks of every kind and bidirectional overrides.
"""

from __future__ import annotations

import json
import logging
import re
import time
from datetime import UTC, datetime
from typing import Any

from shared.config.settings import Settings
from shared.telemetry.request_ids import current_request_id

TEXT_FORMAT = "%(asctime)s %(levelname)s %(name)s: %(message)s"
OWN_LOGGERS = ("lab", "services", "shared")
# Third-party loggers, limited to warnings.
QUIET_LOGGERS = (
    "alembic",
    "celery",
    "httpx2",
    "kombu",
    "opentelemetry",
    "sqlalchemy",
    "urllib3",
    "uvicorn",
)

# C0 and C1 controls, DEL, Unicode's line breaks and bidirectional controls, surrogates.
UNSAFE = re.compile("[\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")

# Attributes of every record; any others came as `extra`. `taskName` is set by asyncio.
STANDARD_ATTRIBUTES = frozenset(logging.makeLogRecord({}).__dict__) | {
    "asctime",
    "color_message",  # uvicorn's message with colours
    "message",
    "request_id",
    "service",
    "taskName",
}


class _ContextFilter(logging.Filter):
    """Adds the service name and the request id to each record."""

    def __init__(self, service: str) -> None:
        super().__init__()
        self._service = service

    def filter(self, record: logging.LogRecord) -> bool:
        record.service = self._service
        # A record about another request than the current one has its id already.
        if not hasattr(record, "request_id"):
            record.request_id = current_request_id()
        return True


class _JsonFormatter(logging.Formatter):
    """Formats a record as one JSON object per line.

    Members: `time` (UTC), `level`, `logger`, `service`, `message`, `request_id` if set, `error`
    with a traceback, and the values passed as `extra`.
    """

    def format(self, record: logging.LogRecord) -> str:
        line: dict[str, Any] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname,
            "logger": record.name,
            "service": getattr(record, "service", None),
            "message": record.getMessage(),
        }
        if (request_id := getattr(record, "request_id", None)) is not None:
            line["request_id"] = request_id
        line |= _extra(record)
        if record.exc_info:
            line["error"] = self.formatException(record.exc_info)
        text = json.dumps(line, ensure_ascii=False, default=str)
        return UNSAFE.sub(lambda match: f"\\u{ord(match[0]):04x}", text)


class _TextFormatter(logging.Formatter):
    """Formats a record for people, with the request id and the `extra` values at the end.

    Times are UTC. The lines of a traceback are indented, so that no text of an error can look like
    a log line.
    """

    converter = time.gmtime  # type: ignore[assignment]
    default_time_format, default_msec_format = "%Y-%m-%dT%H:%M:%S", "%s.%03dZ"

    def __init__(self) -> None:
        super().__init__(TEXT_FORMAT)

    def format(self, record: logging.LogRecord) -> str:
        line, *trace = super().format(record).split("\n")
        return "\n".join([line, *(f"  {_escape(trace_line)}" for trace_line in trace)])

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802  (logging's name)
        message = super().formatMessage(record)
        fields = _extra(record)
        if (request_id := getattr(record, "request_id", None)) is not None:
            fields["request_id"] = request_id
        return _escape(" ".join([message, *(f"{name}={value}" for name, value in fields.items())]))


def _escape(text: str) -> str:
    """Replace unsafe characters by Python's escape sequences: `\\n`, `\\x1b`, `\\u2028`."""
    return UNSAFE.sub(lambda match: match[0].encode("unicode_escape").decode(), text)


def _extra(record: logging.LogRecord) -> dict[str, Any]:
    return {
        name: value for name, value in record.__dict__.items() if name not in STANDARD_ATTRIBUTES
    }


def configure_logging(settings: Settings, service: str, *, for_operators: bool = True) -> None:
    """Log to stderr in the format of LOG_FORMAT, with debug lines if DEBUG is set.

    Replaces the existing handlers of the root logger.

    Args:
        for_operators: If False, a terminal shows no lines below WARNING, unless DEBUG is set.
    """
    stderr = logging.StreamHandler()
    if not for_operators and not settings.debug and stderr.stream.isatty():
        stderr.setLevel(logging.WARNING)
    stderr.addFilter(_ContextFilter(service))
    stderr.setFormatter(_JsonFormatter() if settings.log_format == "json" else _TextFormatter())
    root = logging.getLogger()
    root.handlers[:] = [stderr]
    root.setLevel(logging.INFO)
    for name in OWN_LOGGERS:
        logging.getLogger(name).setLevel(logging.DEBUG if settings.debug else logging.INFO)
    for name in QUIET_LOGGERS:
        logging.getLogger(name).setLevel(logging.WARNING)
