"""Streaming reads and writes of objects in a bucket.

`S3Reader` streams an object with one request; a seek starts another one. `S3Writer` sends an object
in parts while it is written, so that its size need not be known and it need not fit into memory.
"""

from __future__ import annotations

import io
import logging
import os
from typing import TYPE_CHECKING

from minio.datatypes import Part
from minio.error import S3Error
from urllib3.response import BaseHTTPResponse

from shared.errors import Unavailable
from shared.storage.s3.bucket import Bucket

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer


log = logging.getLogger(__name__)

RANGE_NOT_SATISFIABLE_CODE = "InvalidRange"


class S3Reader(io.RawIOBase):
    """An unbuffered reader; every request reads the version first opened."""

    def __init__(self, bucket: Bucket, key: str) -> None:
        super().__init__()
        self._bucket = bucket
        self._key = key
        self._position = 0
        self._etag: str | None = None
        self._response: BaseHTTPResponse | None = self._request(0)
        self._etag = self._response.headers.get("etag")
        try:
            self._size = int(self._response.headers["content-length"])
        except (KeyError, ValueError):
            raise bucket.incomplete_response_error(key) from None

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._position

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        begin = {os.SEEK_SET: 0, os.SEEK_CUR: self._position, os.SEEK_END: self._size}[whence]
        position = begin + offset
        if position < 0:
            raise ValueError(f"position {position} is before the beginning of the object")
        if position != self._position:
            self._release_connection()
        self._position = position
        return position

    def readinto(self, buffer: WriteableBuffer) -> int:
        view = memoryview(buffer).cast("B")
        data = self._read(len(view))
        view[: len(data)] = data
        return len(data)

    def readall(self) -> bytes:
        return self._read(None)

    def close(self) -> None:
        if not self.closed:
            self._release_connection()
        super().close()

    def _read(self, max_bytes: int | None) -> bytes:
        """Read up to `max_bytes` from the position, or the rest for None; b"" only at the end."""
        remaining = self._size - self._position
        requested = remaining if max_bytes is None else min(remaining, max_bytes)
        if requested <= 0:
            return b""
        if self._response is None:
            self._response = self._request(self._position)
        with self._bucket.translate_errors(self._key):
            data = self._response.read(requested)
        if len(data) < (requested if max_bytes is None else 1):
            raise self._bucket.incomplete_response_error(self._key)
        self._position += len(data)
        return data

    def _request(self, begin: int) -> BaseHTTPResponse:
        headers: dict[str, str | list[str] | tuple[str]] = {}
        if self._etag is not None:
            headers["If-Match"] = self._etag
        with self._bucket.translate_errors(self._key):
            return self._bucket.client.get_object(
                self._bucket.name, self._key, offset=begin, request_headers=headers
            )

    def _release_connection(self) -> None:
        """Return the connection to the pool; close it when unread data would follow."""
        response, self._response = getattr(self, "_response", None), None
        if response is None:
            return
        if self._position < self._size:
            response.close()
        response.release_conn()


def read_range(bucket: Bucket, key: str, begin: int, size_bytes: int) -> bytes:
    """Read up to `size_bytes` from `begin` with one request; b"" after the object's end."""
    if size_bytes <= 0:
        return b""  # the client would read everything for 0
    with bucket.translate_errors(key):
        try:
            response = bucket.client.get_object(bucket.name, key, offset=begin, length=size_bytes)
        except S3Error as error:
            if error.code != RANGE_NOT_SATISFIABLE_CODE:
                raise
            return b""
        try:
            return response.read()  # raises when the response is shorter than its Content-Length
        finally:
            response.release_conn()


# S3's minimum size of a part that is not the last one. Small parts keep the memory of a writer and
# the time of one request small; S3's maximum of 10,000 such parts is 52 GB.
PART_BYTES = 5 * 1024 * 1024


class MultipartUpload:
    """A multipart upload, sent part by part.

    The client's public methods send parts only of a stream that they read themselves, but a writer
    receives its data block by block. Hence the use of four private methods, all of them here, and
    the narrow version range in pyproject.toml.
    """

    def __init__(self, bucket: Bucket, key: str) -> None:
        """Start the upload. Raises as `Bucket.translate_errors` does, and so do all methods."""
        self._bucket = bucket
        self._key = key
        self._parts: list[Part] = []
        with bucket.translate_errors():
            self._id = bucket.client._create_multipart_upload(bucket.name, key, {})

    def send_part(self, data: bytes) -> None:
        number = len(self._parts) + 1
        with self._bucket.translate_errors():
            etag = self._bucket.client._upload_part(
                self._bucket.name, self._key, data, None, self._id, number
            )
        self._parts.append(Part(number, etag))

    def complete(self) -> None:
        with self._bucket.translate_errors():
            result = self._bucket.client._complete_multipart_upload(
                self._bucket.name, self._key, self._id, self._parts
            )
        if result.etag is None:
            # S3 sends the status 200 before it is done; the body then reports an error.
            raise Unavailable(
                "object_store_unavailable",
                f"The object store at {self._bucket.endpoint} could not complete a "
                "multipart upload. Try again.",
            )

    def abort(self) -> None:
        with self._bucket.translate_errors():
            self._bucket.client._abort_multipart_upload(self._bucket.name, self._key, self._id)


class S3Writer:
    """Sends an object as a multipart upload; one that fits into a single part, in one request.

    At most one part is in memory. The bucket's lifecycle rule removes the parts of a killed process
    (`create_bucket`).
    """

    def __init__(self, bucket: Bucket, key: str) -> None:
        self._bucket = bucket
        self._key = key
        self._buffer = bytearray()
        self._upload: MultipartUpload | None = None

    def write(self, data: bytes) -> None:
        remaining = memoryview(data)
        while remaining:
            if len(self._buffer) == PART_BYTES:
                self._send_part()
            free_bytes = PART_BYTES - len(self._buffer)
            self._buffer += remaining[:free_bytes]
            remaining = remaining[free_bytes:]

    def commit(self) -> None:
        if self._upload is None:
            with self._bucket.translate_errors():
                self._bucket.client.put_object(
                    self._bucket.name, self._key, io.BytesIO(self._buffer), len(self._buffer)
                )
        else:
            self._send_part()
            self._upload.complete()
            self._upload = None

    def abort(self) -> None:
        self._buffer.clear()
        upload, self._upload = self._upload, None
        if upload is None:
            return
        try:
            upload.abort()
        except Unavailable as error:
            # They are not visible as an object, and the lifecycle rule removes them.
            log.warning("could not abort the multipart upload of %s: %s", self._key, error.detail)

    def _send_part(self) -> None:
        if self._upload is None:
            self._upload = MultipartUpload(self._bucket, self._key)
        self._upload.send_part(bytes(self._buffer))
        self._buffer.clear()
