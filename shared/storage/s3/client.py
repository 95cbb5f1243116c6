"""The minio client, signing by the store's clock where this machine's is wrong.

S3 refuses what is signed more than 15 minutes off. A machine whose clock was set wrong would be
shut out until someone notices; every answer tells the store's time, so that it need not be.

Connections that notice when an answer's head was cut off.

http.client takes the end of a connection for the end of the head. What is missing then reads as
"not said" or, cut within a number, as a smaller one: an object without a size, or a short one.
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
# Less than this is no reason to be refused, and a proxy's Date may be off by a little.
SKEW = timedelta(minutes=5)


class S3Client(Minio):
    """Overrides two inner calls of the client: hence its narrow range in pyproject.toml."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._ahead = timedelta()

    def now(self) -> datetime:
        """The store's time, UTC, as far as it is known."""
        return datetime.now(UTC) + self._ahead

    def _build_headers(self, *arguments: Any, **options: Any) -> tuple[dict[str, Any], datetime]:
        headers, date = super()._build_headers(*arguments, **options)
        date += self._ahead
        headers["x-amz-date"] = to_amz_date(date)
        return headers, date

    def _url_open(self, *arguments: Any, **options: Any) -> BaseHTTPResponse:
        try:
            answer: BaseHTTPResponse = super()._url_open(*arguments, **options)
        except S3Error as error:
            # An answer without a body (to HEAD) does not say why it refuses.
            if error.response.status != FORBIDDEN or not self._follow(error.response):
                raise
            answer = super()._url_open(*arguments, **options)
        return answer

    def _follow(self, answer: BaseHTTPResponse) -> bool:
        """Take over the store's time; whether it differs from what was thought."""
        try:
            said = parsedate_to_datetime(answer.headers["date"])
        except (KeyError, ValueError):
            return False
        if said.tzinfo is None or abs(said - self.now()) < SKEW:
            return False
        self._ahead = said - datetime.now(UTC)
        log.warning(
            "this machine's clock or the object store's is wrong: they are %.0f s apart; requests "
            "are signed by the store's",
            abs(self._ahead.total_seconds()),
        )
        return True


BLANK = {b"\r\n", b"\n"}


class _Lines:
    """A file whose last line is remembered while an answer's head is read from it."""

    def __init__(self, file: Any) -> None:
        self.file = file
        self.last = b""

    def readline(self, most_bytes: int = -1) -> bytes:
        self.last = self.file.readline(most_bytes)
        return self.last

    def close(self) -> None:
        self.file.close()


class _WholeAnswer(http.client.HTTPResponse):
    fp: Any

    def begin(self) -> None:
        """Raises RemoteDisconnected where the connection ended before the head did."""
        lines = _Lines(self.fp)
        self.fp = lines
        try:
            super().begin()
        finally:
            if self.fp is lines:
                self.fp = lines.file
        if lines.last not in BLANK:
            raise http.client.RemoteDisconnected("The connection ended within an answer's head")


class _HTTPConnection(HTTPConnection):
    response_class = _WholeAnswer


class _HTTPSConnection(HTTPSConnection):
    response_class = _WholeAnswer


class _HTTPPool(urllib3.HTTPConnectionPool):
    ConnectionCls = _HTTPConnection


class _HTTPSPool(urllib3.HTTPSConnectionPool):
    ConnectionCls = _HTTPSConnection


class Connections(urllib3.PoolManager):
    """As urllib3's own, with these connections."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.pool_classes_by_scheme = {"http": _HTTPPool, "https": _HTTPSPool}
