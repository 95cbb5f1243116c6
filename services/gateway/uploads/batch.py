"""Streaming parser of batch uploads: many files, or a manifest or a prefix of object keys.

The files are written to the object store while they are received. Each file is validated on its
own: a refused file becomes a failed item of the batch, and the rest of its bytes is skipped. If the
whole body is refused, nothing is left in the store.
"""

from __future__ import annotations

import hashlib
from collections import deque
from dataclasses import dataclass, field
from typing import Any

from fastapi import Request
from starlette.concurrency import run_in_threadpool

from services.gateway.uploads.multipart import MultipartFormParser
from shared.config.settings import Settings
from shared.errors import InvalidRequest, PlacewiseError, TooLarge, invalid_field_error
from shared.imaging.file_formats import photo_suffix
from shared.ingest.photo_metadata import MAX_MANIFEST_BYTES
from shared.ingest.validation import StreamValidator, check_photo_signature
from shared.storage import ObjectStore, ObjectWriter
from shared.storage.keys import new_original_key

FILES_FIELD, MANIFEST_FIELD, PREFIX_FIELD = "file", "manifest", "prefix"
# Of all files of one request, which takes a quarter of an hour at 100 Mbit/s: an interrupted one
# begins again, and several requests can be sent.
MAX_FILES_BYTES = 10 * 2**30
MAX_PART_HEADER_BYTES = 1024
MAX_PREFIX_BYTES = 1024  # the maximum length of an S3 key


@dataclass(slots=True)
class BatchFile:
    """A file of the form: stored under `key`, or refused with `error`."""

    name: str
    key: str
    size_bytes: int = 0
    sha256: str = ""
    error: PlacewiseError | None = None


@dataclass(slots=True)
class BatchUpload:
    """The parsed body of a batch upload."""

    files: list[BatchFile] = field(default_factory=list)
    manifest: bytes | None = None
    prefix: str | None = None

    def idempotency_content(self) -> list[Any]:
        """Content for the idempotency fingerprint: equal for the same files and manifest."""
        return [
            [[file.name, file.sha256] for file in self.files],
            None if self.manifest is None else hashlib.sha256(self.manifest).hexdigest(),
            *([] if self.prefix is None else [self.prefix]),
        ]


async def parse_batch_upload(
    request: Request, store: ObjectStore, settings: Settings
) -> BatchUpload:
    """Parse the body of a batch upload and store its files.

    Nothing is left in the store if it raises; `discard_batch_upload` deletes the files later.

    Raises:
        InvalidRequest: `no_file`, `several_sources`, `empty_file`, `malformed_body`.
        TooLarge: `batch_too_large`, `too_many_photos`, `manifest_too_large`.
        UnsupportedMedia: `unsupported_body`.
        Unprocessable: `invalid_field`.
    """
    max_bytes = (
        MAX_FILES_BYTES + MAX_MANIFEST_BYTES + settings.max_batch_photos * MAX_PART_HEADER_BYTES
    )
    parts = _BatchPartHandler(store, settings)
    form = MultipartFormParser(request, parts, max_bytes, _batch_too_large_error)
    try:
        async for piece in request.stream():
            form.feed(piece)
            await run_in_threadpool(parts.write)
        form.finish()
        received = parts.batch
        if not received.files and received.manifest is None:
            if received.prefix is None:
                raise InvalidRequest(
                    "no_file",
                    f"The form has no photos ({FILES_FIELD!r}, once for each), no manifest of keys "
                    f"({MANIFEST_FIELD!r}) and no prefix of keys ({PREFIX_FIELD!r}). Send one of "
                    "them: curl -F file=@1.jpg -F file=@2.jpg.",
                )
        elif received.prefix is not None:
            raise _conflicting_sources_error("a prefix and another source")
    except BaseException:
        await run_in_threadpool(parts.discard)
        raise
    return received


def discard_batch_upload(store: ObjectStore, received: BatchUpload) -> None:
    """Delete the stored files of the batch."""
    for file in received.files:
        if file.error is None:
            store.delete(file.key)


def _batch_too_large_error() -> PlacewiseError:
    return TooLarge(
        "batch_too_large",
        f"The files of the batch are larger than {MAX_FILES_BYTES} bytes together. Split the batch "
        "into several.",
        max_bytes=MAX_FILES_BYTES,
    )


class _BatchPartHandler:
    """Collects the parts of the form.

    `begin`, `data` and `end` only queue the data on the event loop; `write` validates and stores it
    and is called in a worker thread.
    """

    def __init__(self, store: ObjectStore, settings: Settings) -> None:
        self.batch = BatchUpload()
        self._store = store
        self._settings = settings
        self._name = ""
        self._manifest = bytearray()
        self._prefix = bytearray()
        self._files_bytes = 0
        self._write_queue: deque[tuple[BatchFile, bytes | None]] = deque()
        """The bytes of the files, in order; None marks the end of a file."""
        self._file: BatchFile | None = None
        self._validator: StreamValidator | None = None
        self._writer: ObjectWriter | None = None

    def discard(self) -> None:
        """Abort the current write and delete the files."""
        self._abort_write()
        discard_batch_upload(self._store, self.batch)

    def begin(self, name: str, filename: str | None) -> None:
        self._name = name
        if name == MANIFEST_FIELD:
            if self.batch.manifest is not None:
                raise _conflicting_sources_error("two manifests")
            self.batch.manifest = b""
        elif name == PREFIX_FIELD:
            if self.batch.prefix is not None:
                raise _conflicting_sources_error("two prefixes")
            self.batch.prefix = ""
        elif name != FILES_FIELD:
            raise invalid_field_error(
                name,
                f"is unknown; valid are {FILES_FIELD}, {MANIFEST_FIELD} and {PREFIX_FIELD}. Put "
                "the fields of single photos into the manifest. The server takes no archives: "
                "unpack yours, or run placewise index ARCHIVE",
            )
        elif filename is None:
            raise InvalidRequest(
                "no_file",
                f"The field {name!r} is not a file. Send it as curl -F {name}=@PATH (with the @).",
            )
        else:
            if len(self.batch.files) == self._settings.max_batch_photos:
                raise too_many_photos_error(self._settings.max_batch_photos)
            key = new_original_key(photo_suffix(filename))
            self._file = BatchFile(_display_name(filename), key)
            self.batch.files.append(self._file)

    def data(self, piece: bytes) -> None:
        if self._name == MANIFEST_FIELD:
            self._manifest += piece
            if len(self._manifest) > MAX_MANIFEST_BYTES:
                raise TooLarge(
                    "manifest_too_large",
                    f"The manifest is larger than {MAX_MANIFEST_BYTES} bytes. Split it into "
                    "several.",
                )
            return
        if self._name == PREFIX_FIELD:
            self._prefix += piece
            if len(self._prefix) > MAX_PREFIX_BYTES:
                raise invalid_field_error(PREFIX_FIELD, f"has more than {MAX_PREFIX_BYTES} bytes")
            return
        self._files_bytes += len(piece)
        if self._files_bytes > MAX_FILES_BYTES:
            raise _batch_too_large_error()
        assert self._file is not None
        self._write_queue.append((self._file, piece))

    def end(self) -> None:
        if self._name == MANIFEST_FIELD:
            self.batch.manifest = bytes(self._manifest)
        elif self._name == PREFIX_FIELD:
            try:
                self.batch.prefix = self._prefix.decode()
            except UnicodeDecodeError:
                raise invalid_field_error(PREFIX_FIELD, "is not UTF-8") from None
        else:
            assert self._file is not None
            self._write_queue.append((self._file, None))

    def write(self) -> None:
        """Validate and store the bytes received since the last call."""
        while self._write_queue:
            file, piece = self._write_queue.popleft()
            if file.error is not None:
                continue  # skip the rest of a refused file
            try:
                self._finish(file) if piece is None else self._write(file, piece)
            except PlacewiseError as error:
                self._abort_write()
                if error.status >= 500:
                    raise
                file.error = error

    def _write(self, file: BatchFile, piece: bytes) -> None:
        if self._validator is None:
            self._validator = StreamValidator(self._settings.max_file_size, check_photo_signature)
        self._validator.add(piece)
        if self._writer is None:
            self._writer = self._store.writer(file.key)
        self._writer.write(piece)

    def _finish(self, file: BatchFile) -> None:
        if self._validator is None or self._writer is None:
            raise InvalidRequest("empty_file", f"The file {file.name!r} is empty.")
        self._validator.end()
        self._writer.commit()
        file.size_bytes, file.sha256 = self._validator.size_bytes, self._validator.sha256
        self._validator = self._writer = None

    def _abort_write(self) -> None:
        if self._writer is not None:
            self._writer.abort()
        self._validator = self._writer = None


def too_many_photos_error(limit: int) -> PlacewiseError:
    """Build the 413 error for a batch of more than `limit` photos."""
    return TooLarge(
        "too_many_photos",
        f"The batch has more than {limit} photos (half of MAX_QUEUED_JOBS). Split it into several.",
    )


def _display_name(filename: str) -> str:
    """The client's file name without control characters; manifest lines refer to it."""
    return "".join(c for c in filename if c.isprintable())[:1000] or "photo"


def _conflicting_sources_error(what: str) -> PlacewiseError:
    return InvalidRequest(
        "several_sources",
        f"The form has {what}. A batch is one of: photos ({FILES_FIELD!r}) with an optional "
        f"{MANIFEST_FIELD!r}; one {MANIFEST_FIELD!r} of keys; one {PREFIX_FIELD!r} of keys.",
    )
