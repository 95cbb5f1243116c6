"""The object store port on a bucket. Many processes may use one at the same time."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC
from pathlib import Path
from typing import BinaryIO

from minio.commonconfig import REPLACE, CopySource
from minio.error import S3Error

from shared.errors import NotFound
from shared.objects.keys import check_key
from shared.objects.port import ObjectInfo, PresignedPut
from shared.objects.s3.bucket import NO_KEY, Bucket
from shared.objects.s3.presign import presign_put
from shared.objects.s3.reader import S3Reader, open_object, read_range
from shared.objects.s3.writer import S3Writer

PROBE = ".placewise-check"  # no object: an upload that is begun and given up


class S3Store:
    """Objects in a bucket that exists; `create_bucket` makes one."""

    def __init__(self, bucket: Bucket) -> None:
        self.bucket = bucket

    def writer(self, key: str) -> S3Writer:
        return S3Writer(self.bucket, check_key(key))

    def put(self, key: str, data: bytes) -> None:
        writer = self.writer(key)
        try:
            writer.write(data)
            writer.commit()
        finally:
            writer.abort()

    def get(self, key: str) -> bytes:
        with S3Reader(self.bucket, check_key(key)) as file:
            return file.readall()

    def open(self, key: str) -> BinaryIO:
        return open_object(self.bucket, check_key(key))

    def read_range(self, key: str, begin: int, size_bytes: int) -> bytes:
        return read_range(self.bucket, check_key(key), begin, size_bytes)

    def file(self, key: str) -> Path | None:
        return None

    def head(self, key: str) -> ObjectInfo | None:
        check_key(key)
        client, bucket = self.bucket.client, self.bucket.name
        with self.bucket.explained(key):
            try:
                found = client.stat_object(bucket, key)
            except S3Error as error:
                if error.code not in NO_KEY:
                    raise
                # This answer has no body, which would tell a missing bucket from a missing key.
                if not client.bucket_exists(bucket):
                    raise self.bucket.missing() from error
                return None
        assert found.last_modified is not None, "S3 always sends it"
        assert found.size is not None
        return ObjectInfo(key, found.size, found.last_modified.astimezone(UTC))

    def delete(self, key: str) -> None:
        check_key(key)
        try:
            with self.bucket.explained(key):
                self.bucket.client.remove_object(self.bucket.name, key)
        except NotFound:
            return  # S3 says nothing of it; some servers do

    def list(self, prefix: str) -> Iterator[ObjectInfo]:
        with self.bucket.explained():
            for found in self.bucket.client.list_objects(
                self.bucket.name, prefix=prefix, recursive=True
            ):
                key = found.object_name
                if key is None or found.last_modified is None or key.endswith("/"):
                    continue  # the "folder" of some console: no key of ours ends like that
                # A HEAD tells whole seconds, and the two have to agree.
                at = found.last_modified.astimezone(UTC).replace(microsecond=0)
                yield ObjectInfo(key, found.size or 0, at)

    def presign_put(
        self, key: str, *, size_bytes: int, sha256: str, expires_seconds: int
    ) -> PresignedPut:
        return presign_put(
            self.bucket,
            check_key(key),
            size_bytes=size_bytes,
            sha256=sha256,
            expires_seconds=expires_seconds,
        )

    def copy(self, source: str, target: str) -> None:
        client, bucket = self.bucket.client, self.bucket.name
        with self.bucket.explained(check_key(source)):
            # What the sender said of the bytes (a type, an encoding) is not taken over.
            client.copy_object(
                bucket,
                check_key(target),
                CopySource(bucket, source),
                metadata_directive=REPLACE,
            )

    def check(self) -> None:
        """Asks whether the bucket is there and may be written to. A full disk shows only when
        something is written: a probe that is an object would leave a version at each check in a
        bucket that keeps them."""
        client, bucket = self.bucket.client, self.bucket.name
        with self.bucket.explained():
            # First of all, because some servers make a missing bucket when it is written to.
            if not client.bucket_exists(bucket):
                raise self.bucket.missing()
            upload_id = client._create_multipart_upload(bucket, PROBE, {})
            client._abort_multipart_upload(bucket, PROBE, upload_id)
