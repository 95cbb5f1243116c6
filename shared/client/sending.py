"""What the asynchronous and the synchronous client share: files, and when to repeat a call."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import random
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import httpx2

from shared.errors import (
    Conflict,
    InvalidRequest,
    PlacewiseError,
    TooManyRequests,
    error_from_response,
)

API = "/api/v1"
IDEMPOTENCY_KEY = "Idempotency-Key"
FINISHED = ("succeeded", "failed", "cancelled")
POLL_SECONDS = 20.0  # one long poll
TIMEOUT_SECONDS = 90.0  # of one call: longer than the longest wait that a server grants
CHUNK_BYTES = 256 * 1024
INITIAL_BACKOFF_SECONDS = 0.5  # the first wait, where the server has not said how long; it doubles
MAX_BACKOFF_SECONDS = 8.0  # what it doubles to
MAX_RETRY_AFTER_SECONDS = 300.0  # whatever the server says

Json = dict[str, Any]
OnWait = Callable[[PlacewiseError, float], object]
"""Told of each wait before it begins: why, and how many seconds."""


class Seekable(Protocol):
    def seek(self, offset: int, whence: int = ..., /) -> int: ...


@dataclass(frozen=True, slots=True)
class RetryPolicy:
    """For how long a call is repeated, and who is told."""

    seconds: float = 0.0
    on_wait: OnWait = lambda error, seconds: None

    def wait_seconds(self, error: PlacewiseError, attempt: int, deadline_passed: bool) -> float:
        """How long to wait after the `attempt`th failure (from 0); raises the error where waiting
        does not help, or patience has ended."""
        if not self.seconds or not _is_retryable(error, deadline_passed):
            raise error
        said = error.extra.get("retry_after_seconds")
        if said is None:
            # Up to a quarter more: callers that were cut off together don't come back together.
            doubled = min(INITIAL_BACKOFF_SECONDS * 2.0**attempt, MAX_BACKOFF_SECONDS)
            seconds = doubled * random.uniform(1, 1.25)  # noqa: S311
        else:
            seconds = min(max(float(said), INITIAL_BACKOFF_SECONDS), MAX_RETRY_AFTER_SECONDS)
        self.on_wait(error, seconds)
        return seconds


def _is_retryable(error: PlacewiseError, deadline_passed: bool) -> bool:
    """Is it worth waiting for what the error speaks of to pass?"""
    if isinstance(error, TooManyRequests):
        return True
    if isinstance(error, Conflict):  # our own call, whose answer was lost, is still under way
        return error.code == "idempotency_key_in_use" and not deadline_passed
    return not deadline_passed


def validate_url(url: str, key: str | None) -> str:
    """The address without its last slash.

    Raises InvalidRequest: `bad_key` for a key that no header can carry, `bad_address`.
    """
    if key is not None and not (key.isascii() and key.isprintable()):
        raise InvalidRequest("bad_key", "A key is made of printable ASCII characters.")
    if not url.startswith(("http://", "https://")):
        raise InvalidRequest("bad_address", f"{url!r} is no address such as http://127.0.0.1:8000.")
    return url.rstrip("/")


def response_error(answer: httpx2.Response) -> PlacewiseError:
    """What an answer that is no success means."""
    error = error_from_response(answer.status_code, answer.text)
    after = answer.headers.get("retry-after", "")
    if after.isdigit():  # a proxy may be the one who says it
        error.extra.setdefault("retry_after_seconds", int(after))
    return error


@contextlib.contextmanager
def open_file(file: Path) -> Iterator[BinaryIO]:
    try:
        with file.open("rb") as stream:
            yield stream
    except OSError as error:
        raise unreadable_file_error(file, error) from error


def unreadable_file_error(file: Path, error: OSError) -> InvalidRequest:
    return InvalidRequest("unreadable_file", f"Can't read {file}: {error.strerror}")


def printable_name(file: Path) -> str:
    """The file's name as text, also where it is not UTF-8."""
    return os.fsencode(file.name).decode("utf-8", "replace")


def size_and_sha256(file: BinaryIO) -> tuple[int, str]:
    """Bytes, and their SHA-256 in hexadecimal."""
    digest, size = hashlib.sha256(), 0
    while piece := file.read(CHUNK_BYTES):
        digest.update(piece)
        size += len(piece)
    return size, digest.hexdigest()


def drop_none(**params: Any) -> Json:
    """Those that are not None."""
    return {name: value for name, value in params.items() if value is not None}


def to_jsonl(objects: Sequence[Json]) -> bytes:
    """JSONL."""
    return b"".join(json.dumps(one).encode() + b"\n" for one in objects)


class ReadProgressFile(io.BufferedIOBase):
    """A file that tells how far it was read."""

    def __init__(self, file: BinaryIO, on_read: Callable[[int], object]) -> None:
        self._file = file
        self._on_read = on_read

    def read(self, size: int | None = -1) -> bytes:
        data = self._file.read(-1 if size is None else size)
        self._on_read(self._file.tell())
        return data

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        return self._file.tell()

    def fileno(self) -> int:
        return self._file.fileno()

    def close(self) -> None:
        self._file.close()
        super().close()
