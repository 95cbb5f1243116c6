"""The object store in a bucket. Several processes may share a bucket."""

from __future__ import annotations

import io
from collections.abc import Iterator
from datetime import UTC
from pathlib import Path
from typing import BinaryIO

from minio.commonconfig import CopySource
from minio.error import S3Error

from shared.errors import NotFound
from shared.storage.keys import check_key, check_note_name
from shared.storage.protocol import ObjectInfo, writing
from shared.storage.s3.bucket import NO_SUCH_KEY_CODES, Bucket
from shared.storage.s3.streams import MultipartUpload, S3Reader, S3Writer, read_range

BUFFER_BYTES = 64 * 1024
PROBE_KEY = ".placewise-check"  # of a multipart upload that is created and aborted


class S3Store:
    """The object store in an existing bucket; `create_bucket` creates one."""

    def __init__(self, bucket: Bucket) -> None:
        self.bucket = bucket

    def writer(self, key: str) -> S3Writer:
        return S3Writer(self.bucket, check_key(key))

    def put(self, key: str, data: bytes) -> None:
        with writing(self, key) as writer:
            writer.write(data)

    def get(self, key: str) -> bytes:
        with S3Reader(self.bucket, check_key(key)) as file:
            return file.readall()

    def open(self, key: str) -> BinaryIO:
        return io.BufferedReader(S3Reader(self.bucket, check_key(key)), BUFFER_BYTES)

    def read_range(self, key: str, begin: int, size_bytes: int) -> bytes:
        return read_range(self.bucket, check_key(key), begin, size_bytes)

    def file(self, key: str) -> Path | None:
        return None

    def head(self, key: str) -> ObjectInfo | None:
        check_key(key)
        client, bucket = self.bucket.client, self.bucket.name
        with self.bucket.translate_errors(key):
            try:
                stat = client.stat_object(bucket, key)
            except S3Error as error:
                if error.code not in NO_SUCH_KEY_CODES:
                    raise
                # A HEAD response has no body that would tell a missing bucket from a missing key.
                if not client.bucket_exists(bucket):
                    raise self.bucket.missing_error() from error
                return None
        if (
            stat.last_modified is None
            or stat.size is None
            or "content-length" not in (stat.metadata or {})
        ):
            raise self.bucket.incomplete_response_error(key)
        return ObjectInfo(key, stat.size, stat.last_modified.astimezone(UTC))

    def delete(self, key: str) -> None:
        check_key(key)
        try:
            with self.bucket.translate_errors(key):
                self.bucket.client.remove_object(self.bucket.name, key)
        except NotFound:
            return  # S3 does not report a missing key; some servers do

    def list(self, prefix: str) -> Iterator[ObjectInfo]:
        with self.bucket.translate_errors():
            for listed in self.bucket.client.list_objects(
                self.bucket.name, prefix=prefix, recursive=True
            ):
                key = listed.object_name
                if key is None or listed.last_modified is None or key.endswith("/"):
                    continue  # a "folder" created by a web console
                # HEAD responses have whole seconds, and `head` and `list` must agree.
                modified_at = listed.last_modified.astimezone(UTC).replace(microsecond=0)
                yield ObjectInfo(key, listed.size or 0, modified_at)

    def move(self, source: str, target: str) -> None:
        client, bucket = self.bucket.client, self.bucket.name
        check_key(source), check_key(target)
        with self.bucket.translate_errors(source):
            client.copy_object(bucket, target, CopySource(bucket, source))
        self.delete(source)

    def free_trash(self, min_free_bytes: int) -> int:
        return 0  # the server's disk is not local

    def read_note(self, name: str) -> bytes | None:
        try:
            return self.get(check_note_name(name))
        except NotFound:
            return None

    def write_note(self, name: str, data: bytes, *, replace: bool = True) -> None:
        # Not every server supports conditional writes: the caller reads the note again.
        if replace or self.read_note(name) is None:
            self.put(check_note_name(name), data)

    def delete_note(self, name: str) -> None:
        self.delete(check_note_name(name))

    def check(self) -> None:
        """Check that the bucket exists and is writable.

        A full disk is not detected, because no object is written: in a bucket with versioning,
        each check would leave a version.
        """
        with self.bucket.translate_errors():
            # Checked first, because some servers create a missing bucket on a write.
            if not self.bucket.client.bucket_exists(self.bucket.name):
                raise self.bucket.missing_error()
        MultipartUpload(self.bucket, PROBE_KEY).abort()
