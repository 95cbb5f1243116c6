"""Connections that notice when an answer's head was cut off.

http.client takes the end of a connection for the end of the head. What is missing then reads as
"not said" or, cut within a number, as a smaller one: an object without a size, or a short one.
"""

from __future__ import annotations

import http.client
from typing import Any

import urllib3
from urllib3.connection import HTTPConnection, HTTPSConnection

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
