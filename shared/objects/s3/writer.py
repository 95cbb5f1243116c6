"""An object sent in parts while it is written, so that its size need not be known or held."""

from __future__ import annotations

import io
import logging
from collections.abc import Callable
from typing import Any

from minio.datatypes import Part

from shared.errors import Unavailable
from shared.objects.s3.bucket import Bucket

log = logging.getLogger(__name__)

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
