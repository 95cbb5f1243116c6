"""The object store port on a bucket. Many processes may use one at the same time.

Addresses at which whoever has one may put one object into the bucket, for a while.

AWS Signature Version 4 in the query (docs.aws.amazon.com, "Authenticating Requests: Using Query
Parameters"). The minio client signs the host alone; here the size and the checksum are signed as
well, so that nothing else can be put there on a server that checks them. Who relies on neither
looks at what was stored.
"""

from __future__ import annotations

import base64
import contextlib
import logging
from collections.abc import Callable, Iterator
from datetime import UTC
from pathlib import Path
from typing import BinaryIO, TypeVar
from urllib.parse import SplitResult

from minio import signer
from minio.commonconfig import REPLACE, CopySource
from minio.error import S3Error
from minio.helpers import queryencode
from minio.time import to_amz_date

from shared.errors import NotFound, StorageFull, Unavailable
from shared.storage.folder import OWNER_MARK
from shared.storage.keys import TRASH, check_key, is_valid_key
from shared.storage.protocol import ObjectInfo, PresignedPut
from shared.storage.s3.bucket import NO_SUCH_KEY_CODES, Bucket
from shared.storage.s3.streams import S3Reader, S3Writer, open_object, read_range

log = logging.getLogger(__name__)

UNSIGNED_PAYLOAD = "UNSIGNED-PAYLOAD"


def presign_put(
    bucket: Bucket, key: str, *, size_bytes: int, sha256: str, expires_seconds: int
) -> PresignedPut:
    """Asks the server nothing. `sha256` in hexadecimal."""
    provider, region = bucket.client._provider, bucket.region
    assert provider is not None, "the settings have both keys"
    credentials = provider.retrieve()
    url = bucket.public.build(method="PUT", region=region, bucket_name=bucket.name, object_name=key)
    checksum = base64.b64encode(bytes.fromhex(sha256)).decode()
    headers = {"Content-Length": str(size_bytes), "x-amz-checksum-sha256": checksum}
    signed = {**headers, "host": url.netloc}

    now = bucket.client.now()
    scope = signer._get_scope(now, region, "s3")
    query = "&".join(
        f"{name}={queryencode(value)}"
        for name, value in {
            "X-Amz-Algorithm": signer.SIGN_V4_ALGORITHM,
            "X-Amz-Credential": f"{credentials.access_key}/{scope}",
            "X-Amz-Date": to_amz_date(now),
            "X-Amz-Expires": str(expires_seconds),
            "X-Amz-SignedHeaders": ";".join(sorted(name.lower() for name in signed)),
        }.items()
    )
    unsigned = SplitResult(url.scheme, url.netloc, url.path, query, "")
    asked, _ = signer._get_canonical_request_hash("PUT", unsigned, signed, UNSIGNED_PAYLOAD)
    signature = signer._get_signature(
        signer._get_signing_key(credentials.secret_key, now, region, "s3"),
        signer._get_string_to_sign(now, scope, asked),
    )
    return PresignedPut(f"{unsigned.geturl()}&X-Amz-Signature={signature}", headers)


T = TypeVar("T")

PROBE_KEY = ".placewise-check"  # no object: an upload that is begun and given up


class S3Store:
    """Objects in a bucket that exists; `create_bucket` makes one."""

    def __init__(self, bucket: Bucket) -> None:
        self.bucket = bucket

    def writer(self, key: str) -> S3Writer:
        return S3Writer(self.bucket, check_key(key), self._with_room)

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
                if error.code not in NO_SUCH_KEY_CODES:
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
        check_key(source), check_key(target)

        def send() -> None:
            with self.bucket.explained(source):
                # What the sender said of the bytes (a type, an encoding) is not taken over.
                client.copy_object(
                    bucket, target, CopySource(bucket, source), metadata_directive=REPLACE
                )

        self._with_room(send)

    def move(self, source: str, target: str) -> None:
        self.copy(source, target)
        self.delete(source)

    def free_trash(self, least_free_bytes: int) -> int:
        return 0  # the server's disk is its own; `_with_room` is for when it says that it is full

    def read_note(self, name: str) -> bytes | None:
        try:
            return self.get(_note(name))
        except NotFound:
            return None

    def write_note(self, name: str, data: bytes, *, replace: bool = True) -> None:
        # Not every server knows conditional writes: who must be the first reads it again.
        if replace or self.read_note(name) is None:
            self.put(_note(name), data)

    def delete_note(self, name: str) -> None:
        self.delete(_note(name))

    def _with_room(self, send: Callable[[], T]) -> T:
        """What `send` returns. Where the store has no room, the trash is emptied first."""
        try:
            return send()
        except StorageFull:
            if not self._empty_trash():
                raise
        return send()

    def _empty_trash(self) -> bool:
        """Delete what lies in the trash; whether there was something."""
        deleted = 0
        with contextlib.suppress(Unavailable):
            for info in self.list(TRASH):
                self.delete(info.key)
                deleted += 1
        if deleted:
            log.warning("the object store is full: %d objects of the trash were deleted", deleted)
        return deleted > 0

    def check(self) -> None:
        """Asks whether the bucket is there and may be written to. A full disk shows only when
        something is written: a probe that is an object would leave a version at each check in a
        bucket that keeps them."""
        client, bucket = self.bucket.client, self.bucket.name
        with self.bucket.explained():
            # First of all, because some servers make a missing bucket when it is written to.
            if not client.bucket_exists(bucket):
                raise self.bucket.missing()
            upload_id = client._create_multipart_upload(bucket, PROBE_KEY, {})
            client._abort_multipart_upload(bucket, PROBE_KEY, upload_id)


def _note(name: str) -> str:
    if not name.startswith(OWNER_MARK) or not is_valid_key(name) or "/" in name:
        raise ValueError(f"not the name of a note: {name!r}")
    return name
