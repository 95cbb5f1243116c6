"""The minio client with two corrections: clock skew, and truncated response heads.

Clock skew: S3 rejects requests whose signature is more than 15 minutes off. The client takes the
time from the store's responses, so that a machine whose clock is wrong is not locked out.

Truncated heads: http.client treats the end of a connection as the end of the head. A missing or
truncated header would then give an object without a size, or a smaller size than it has. The
connections here raise an error instead.
"""

from __future__ import annotations

import http.client
import logging
from datetime import UTC, datetime, timedelta
from email.utils import parsedate_to_datetime
from typing import Any

import urllib3
from minio import Minio
from minio.error import S3Error
from minio.time import to_amz_date
from urllib3.connection import HTTPConnection, HTTPSConnection
from urllib3.response import BaseHTTPResponse

log = logging.getLogger(__name__)

FORBIDDEN = 403
# A smaller difference is not the reason of a rejection, and a proxy's Date may be slightly off.
MIN_SKEW = timedelta(minutes=5)


class S3Client(Minio):
    """The minio client, signing by the store's clock.

    It overrides two private methods: hence the narrow version range in pyproject.toml.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._clock_offset = timedelta()

    def now(self) -> datetime:
        """Return the current time by the store's clock, UTC."""
        return datetime.now(UTC) + self._clock_offset

    def _build_headers(self, *arguments: Any, **options: Any) -> tuple[dict[str, Any], datetime]:
        headers, date = super()._build_headers(*arguments, **options)
        date += self._clock_offset
        headers["x-amz-date"] = to_amz_date(date)
        return headers, date

    def _url_open(self, *arguments: Any, **options: Any) -> BaseHTTPResponse:
        try:
            response: BaseHTTPResponse = super()._url_open(*arguments, **options)
        except S3Error as error:
            # A response without a body (to HEAD) does not give the reason of the rejection.
            if error.response.status != FORBIDDEN or not self._adjust_clock(error.response):
                raise
            response = super()._url_open(*arguments, **options)
        return response

    def _adjust_clock(self, response: BaseHTTPResponse) -> bool:
        """Adopt the store's time; return whether it differs from the time assumed so far."""
        try:
            server_time = parsedate_to_datetime(response.headers["date"])
        except (KeyError, ValueError):
            return False
        if server_time.tzinfo is None or abs(server_time - self.now()) < MIN_SKEW:
            return False
        self._clock_offset = server_time - datetime.now(UTC)
        log.warning(
            "the clock of this machine or of the object store is wrong: they differ by %.0f s; "
            "requests are signed by the store's clock",
            abs(self._clock_offset.total_seconds()),
        )
        return True


BLANK_LINES = {b"\r\n", b"\n"}


class _LastLineReader:
    """A file that remembers its last line, while the head of a response is read from it."""

    def __init__(self, file: Any) -> None:
        self.file = file
        self.last = b""

    def readline(self, max_bytes: int = -1) -> bytes:
        self.last = self.file.readline(max_bytes)
        return self.last

    def close(self) -> None:
        self.file.close()


class _CompleteHeadResponse(http.client.HTTPResponse):
    fp: Any  # replaced while the head is read

    def begin(self) -> None:
        """Read the head; RemoteDisconnected when the connection ended before it did."""
        lines = _LastLineReader(self.fp)
        self.fp = lines
        try:
            super().begin()
        finally:
            if self.fp is lines:
                self.fp = lines.file
        if lines.last not in BLANK_LINES:
            raise http.client.RemoteDisconnected("The connection ended within a response's head")


class _HTTPConnection(HTTPConnection):
    response_class = _CompleteHeadResponse


class _HTTPSConnection(HTTPSConnection):
    response_class = _CompleteHeadResponse


class _HTTPPool(urllib3.HTTPConnectionPool):
    ConnectionCls = _HTTPConnection


class _HTTPSPool(urllib3.HTTPSConnectionPool):
    ConnectionCls = _HTTPSConnection


class Connections(urllib3.PoolManager):
    """urllib3's connection pools with connections that detect a truncated head."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.pool_classes_by_scheme = {"http": _HTTPPool, "https": _HTTPSPool}
