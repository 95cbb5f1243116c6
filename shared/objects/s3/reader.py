"""An object read as a file: one request streams it, and a seek begins another one there."""

from __future__ import annotations

import io
import os
from typing import TYPE_CHECKING

from minio.error import S3Error
from urllib3.response import BaseHTTPResponse

from shared.errors import Unavailable
from shared.objects.s3.bucket import Bucket

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer

BUFFER_BYTES = 64 * 1024
RANGE_NOT_SATISFIABLE_CODE = "InvalidRange"


class S3Reader(io.RawIOBase):
    """Unbuffered; `open_object` gives it a buffer. Every part is of the version first opened."""

    def __init__(self, bucket: Bucket, key: str) -> None:
        super().__init__()
        self._bucket = bucket
        self._key = key
        self._position = 0
        self._etag: str | None = None
        self._answer: BaseHTTPResponse | None = self._request(0)
        self._etag = self._answer.headers.get("etag")
        self._size = int(self._answer.headers["content-length"])

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._position

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        begin = {os.SEEK_SET: 0, os.SEEK_CUR: self._position, os.SEEK_END: self._size}[whence]
        wanted = begin + offset
        if wanted < 0:
            raise ValueError(f"position {wanted} lies before the object")
        if wanted != self._position:
            self._release_connection()
        self._position = wanted
        return wanted

    def readinto(self, buffer: WriteableBuffer) -> int:
        view = memoryview(buffer).cast("B")
        piece = self._read(len(view))
        view[: len(piece)] = piece
        return len(piece)

    def readall(self) -> bytes:
        return self._read(None)

    def close(self) -> None:
        if not self.closed:
            self._release_connection()
        super().close()

    def _read(self, most_bytes: int | None) -> bytes:
        """At most so many bytes from here, all that are left for None; b"" only at the end."""
        left = self._size - self._position
        wanted = left if most_bytes is None else min(left, most_bytes)
        if wanted <= 0:
            return b""
        if self._answer is None:
            self._answer = self._request(self._position)
        with self._bucket.explained(self._key):
            piece = self._answer.read(wanted)
        if len(piece) < (wanted if most_bytes is None else 1):
            raise Unavailable(
                "object_store_unavailable",
                f"The object store at {self._bucket.endpoint} sent {self._key!r} only in part.",
            )
        self._position += len(piece)
        return piece

    def _request(self, begin: int) -> BaseHTTPResponse:
        headers: dict[str, str | list[str] | tuple[str]] = {}
        if self._etag is not None:
            headers["If-Match"] = self._etag
        with self._bucket.explained(self._key):
            return self._bucket.client.get_object(
                self._bucket.name, self._key, offset=begin, request_headers=headers
            )

    def _release_connection(self) -> None:
        """Give the connection back, or close it when more would come over it."""
        answer, self._answer = getattr(self, "_answer", None), None
        if answer is None:
            return
        if self._position < self._size:
            answer.close()
        answer.release_conn()


def open_object(bucket: Bucket, key: str) -> io.BufferedReader:
    """The object as a file; NotFound where there is none. Fetches what is read, and what the
    network has on its way by then."""
    return io.BufferedReader(S3Reader(bucket, key), BUFFER_BYTES)


def read_range(bucket: Bucket, key: str, begin: int, size_bytes: int) -> bytes:
    """Up to so many bytes from `begin`, in one request; b"" behind the object's end."""
    if size_bytes <= 0:
        return b""  # to the client 0 means everything
    with bucket.explained(key):
        try:
            answer = bucket.client.get_object(bucket.name, key, offset=begin, length=size_bytes)
        except S3Error as error:
            if error.code != RANGE_NOT_SATISFIABLE_CODE:
                raise
            return b""
        try:
            return answer.read()  # raises when less comes than was promised
        finally:
            answer.release_conn()
