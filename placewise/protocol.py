"""What both forms of the client share: retry policy, error responses and request bodies."""

from __future__ import annotations

import contextlib
import json
import os
import random
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import httpx2

from shared.errors import InvalidRequest, PlacewiseError, TooManyRequests, error_from_response

API = "/api/v1"
IDEMPOTENCY_KEY = "Idempotency-Key"
POLL_SECONDS = 20.0  # duration of a long poll
PATIENCE_SECONDS = 60.0  # for which calls are retried
TIMEOUT_SECONDS = 90.0  # per call; exceeds the longest long poll that a server allows
CHUNK_BYTES = 256 * 1024
INITIAL_BACKOFF_SECONDS = 0.5  # doubles with each attempt, without Retry-After
MAX_BACKOFF_SECONDS = 8.0
MAX_RETRY_AFTER_SECONDS = 300.0  # upper limit for Retry-After

Json = dict[str, Any]
OnWait = Callable[[PlacewiseError, float], object]
"""Called before each wait with the error and the number of seconds."""


@dataclass(frozen=True, slots=True)
class RetryPolicy:
    """How long calls are retried (`seconds`; 0 disables retries), and a callback for waits."""

    seconds: float = 0.0
    on_wait: OnWait = lambda error, seconds: None

    def wait_seconds(self, error: PlacewiseError, attempt: int, deadline_passed: bool) -> float:
        """Compute the wait before the next attempt, with exponential backoff and jitter.

        Args:
            error: The error of the failed attempt.
            attempt: Number of the failed attempt, from 0.
            deadline_passed: Whether the retry period is over.

        Returns:
            Seconds to wait.

        Raises:
            PlacewiseError: `error` itself, if it is not retryable or the retry period is over.
        """
        is_full = isinstance(error, TooManyRequests)
        if not self.seconds or (deadline_passed and not is_full):
            raise error
        retry_after = error.extra.get("retry_after_seconds")
        if retry_after is None:
            # Jitter of up to a quarter keeps clients from retrying at the same time.
            backoff = min(INITIAL_BACKOFF_SECONDS * 2.0**attempt, MAX_BACKOFF_SECONDS)
            seconds = backoff * random.uniform(1, 1.25)  # noqa: S311
        else:
            seconds = min(max(float(retry_after), INITIAL_BACKOFF_SECONDS), MAX_RETRY_AFTER_SECONDS)
        self.on_wait(error, seconds)
        return seconds


def validate_url(url: str, key: str | None) -> str:
    """Validate a server's URL and API key; returns the URL without `/api/v1` and trailing slash.

    Raises:
        InvalidRequest: `bad_address`; `bad_key` for a key that is not printable ASCII.
    """
    if key is not None and not (key.isascii() and key.isprintable()):
        raise InvalidRequest("bad_key", "An API key must consist of printable ASCII characters.")
    with contextlib.suppress(httpx2.InvalidURL):
        parsed = httpx2.URL(url)
        if parsed.scheme in ("http", "https") and parsed.host and not parsed.query:
            return url.rstrip("/").removesuffix(API)
    raise InvalidRequest(
        "bad_address", f"{url!r} is not a valid URL such as http://127.0.0.1:8000."
    )


def may_use_proxy(url: str) -> bool:
    """Return False for this machine, which no proxy that the environment names can reach."""
    return httpx2.URL(url).host not in ("127.0.0.1", "::1", "localhost")


def response_error(response: httpx2.Response) -> PlacewiseError:
    """Convert an error response to a PlacewiseError."""
    error = error_from_response(response.status_code, response.text)
    retry_after = response.headers.get("retry-after", "")
    if retry_after.isdigit():  # may also come from a proxy, without a problem document
        error.extra.setdefault("retry_after_seconds", int(retry_after))
    return error


@contextlib.contextmanager
def open_file(file: Path) -> Iterator[BinaryIO]:
    """Open a file for reading; InvalidRequest (`unreadable_file`) if that fails."""
    if file.exists() and not (file.is_file() or file.is_dir()):  # a FIFO would block for ever
        raise InvalidRequest("unreadable_file", f"Can't read {file}: it is not a regular file")
    try:
        with file.open("rb") as stream:
            yield stream
    except OSError as error:
        raise InvalidRequest("unreadable_file", f"Can't read {file}: {error.strerror}") from error


def printable_name(file: Path) -> str:
    """The file's name as text; bytes that are not UTF-8 are replaced."""
    return os.fsencode(file.name).decode("utf-8", "replace")


def drop_none(**params: Any) -> Json:
    """The keyword arguments that are not None."""
    return {name: value for name, value in params.items() if value is not None}


def to_text(**params: Any) -> Json:
    """The arguments that are not None, lists as the API reads them (`a,b`), objects as JSON."""
    lists = {k: ",".join(map(str, v)) for k, v in params.items() if isinstance(v, (list, tuple))}
    objects = {name: json.dumps(v) for name, v in params.items() if isinstance(v, dict)}
    return drop_none(**params | lists | objects)


def to_jsonl(objects: Sequence[Json]) -> bytes:
    """Encode objects as JSONL."""
    return b"".join(json.dumps(item).encode() + b"\n" for item in objects)
