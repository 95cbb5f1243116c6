"""An object read as a file: one request streams it, and a seek begins another one there.

An object sent in parts while it is written, so that its size need not be known or held.
"""

from __future__ import annotations

import io
import logging
import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from minio.datatypes import Part
from minio.error import S3Error
from urllib3.response import BaseHTTPResponse

from shared.errors import Unavailable
from shared.storage.s3.bucket import Bucket

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer


log = logging.getLogger(__name__)

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


# S3's least size of a part that is not the last one. Small parts keep a writer's memory and the
# time of one request small; S3's 10,000 parts of them are 52 GB.
PART_BYTES = 5 * 1024 * 1024


class S3Writer:
    """Holds one part at most; what fits into one is sent in one request by `commit`.

    The parts of a killed process are removed by the bucket's rule (`create_bucket`). The client's
    own way to send parts pulls from a stream, and here they are pushed: hence its inner calls,
    and the narrow range of its version in pyproject.toml.
    """

    def __init__(
        self, bucket: Bucket, key: str, with_room: Callable[[Callable[[], Any]], Any]
    ) -> None:
        """`with_room` calls what it is given, and once more where room could be made for it."""
        self._bucket = bucket
        self._with_room = with_room
        self._key = key
        self._buffer = bytearray()
        self._upload_id: str | None = None
        self._parts: list[Part] = []
        self._committed = False

    def write(self, data: bytes) -> None:
        left = memoryview(data)
        while left:
            if len(self._buffer) == PART_BYTES:
                self._send_part()
            room = PART_BYTES - len(self._buffer)
            self._buffer += left[:room]
            left = left[room:]

    def commit(self) -> None:
        client, bucket = self._bucket.client, self._bucket.name
        if self._upload_id is None:

            def send() -> None:
                with self._bucket.explained():
                    data = io.BytesIO(self._buffer)
                    client.put_object(bucket, self._key, data, len(self._buffer))

            self._with_room(send)
        else:
            self._send_part()
            with self._bucket.explained():
                done = client._complete_multipart_upload(
                    bucket, self._key, self._upload_id, self._parts
                )
            if done.etag is None:
                # S3 begins to answer 200 before it knows: the body then says what went wrong.
                raise Unavailable(
                    "object_store_unavailable",
                    f"The object store at {self._bucket.endpoint} could not join the parts of an "
                    "object. Try again.",
                )
        self._committed = True

    def abort(self) -> None:
        self._buffer.clear()
        if self._committed or self._upload_id is None:
            return
        upload_id, self._upload_id = self._upload_id, None
        try:
            with self._bucket.explained():
                self._bucket.client._abort_multipart_upload(self._bucket.name, self._key, upload_id)
        except Unavailable as error:
            # Nothing can be seen of them, and the bucket's rule removes them.
            log.warning("the parts of %s were left in the store: %s", self._key, error.detail)

    def _send_part(self) -> None:
        client, bucket = self._bucket.client, self._bucket.name
        number = len(self._parts) + 1

        def send() -> str:
            with self._bucket.explained():
                if self._upload_id is None:
                    self._upload_id = client._create_multipart_upload(bucket, self._key, {})
                return client._upload_part(
                    bucket, self._key, bytes(self._buffer), None, self._upload_id, number
                )

        self._parts.append(Part(number, self._with_room(send)))
        self._buffer.clear()
