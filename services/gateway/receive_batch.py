"""The body of a batch, stored while it arrives: many files, or one archive, or a list of keys.

Each file is checked on its own: one that is refused is an item that has failed, and the rest of its
bytes is read past. Nothing is left in the store of a body that is refused as a whole.
"""

from __future__ import annotations

import hashlib
from collections import deque
from dataclasses import dataclass, field
from typing import Any

from fastapi import Request
from starlette.concurrency import run_in_threadpool

from services.gateway.form import Form, media_type_of
from shared.archive_formats import ACCEPTED_ARCHIVES, SNIFFED_ARCHIVE_BYTES, sniff_archive
from shared.errors import InvalidRequest, PlacewiseError, TooLarge, UnsupportedMedia, invalid_field
from shared.intake.manifest import MAX_MANIFEST_BYTES
from shared.intake.received import PassingFile, check_photo_begin
from shared.objects import ObjectStore, ObjectWriter
from shared.objects.keys import new_archive_key, new_original_key
from shared.settings import Settings

FILE, ARCHIVE, MANIFEST, PREFIX = "file", "archive", "manifest", "prefix"
NDJSON = ("application/x-ndjson", "application/jsonl", "application/x-jsonlines")
PART_HEADER_BYTES = 1024
MAX_PREFIX_BYTES = 1024  # the longest key that S3 knows


@dataclass(slots=True)
class UploadedFile:
    """A file of the form: stored under `key`, or refused."""

    name: str
    key: str
    size_bytes: int = 0
    sha256: str = ""
    error: PlacewiseError | None = None


@dataclass(slots=True)
class ReceivedBatch:
    files: list[UploadedFile] = field(default_factory=list)
    archive: UploadedFile | None = None
    manifest: bytes | None = None
    prefix: str | None = None

    def as_said(self) -> list[Any]:
        """What the body said, as JSON: equal for the same files and lines."""
        return [
            [[file.name, file.sha256] for file in self.files],
            self.archive and [self.archive.name, self.archive.sha256],
            None if self.manifest is None else hashlib.sha256(self.manifest).hexdigest(),
            *([] if self.prefix is None else [self.prefix]),
        ]


async def receive_batch(request: Request, store: ObjectStore, settings: Settings) -> ReceivedBatch:
    """What came; `discard` removes it again.

    Raises InvalidRequest (`no_file`, `several_sources`, `empty_file`, `malformed_body`), TooLarge
    (`batch_too_large`, `too_many_photos`, `manifest_too_large`), UnsupportedMedia
    (`unsupported_archive`, `unsupported_body`) and Unprocessable (`invalid_field`).
    """
    if media_type_of(request) in NDJSON:
        return ReceivedBatch(manifest=await _read_manifest(request))
    most_bytes = (
        settings.max_archive_size
        + MAX_MANIFEST_BYTES
        + settings.max_batch_photos * PART_HEADER_BYTES
    )
    parts = _Parts(store, settings)
    form = Form(request, parts, most_bytes, lambda: batch_too_large(settings.max_archive_size))
    try:
        async for piece in request.stream():
            form.feed(piece)
            await run_in_threadpool(parts.write)
        form.finish()
        received = parts.batch
        if not received.files and received.archive is None and received.manifest is None:
            if received.prefix is None:
                raise InvalidRequest(
                    "no_file",
                    f"The form has no photos ({FILE!r}, once for each), no archive ({ARCHIVE!r}), "
                    f"no manifest of keys ({MANIFEST!r}) and no prefix of keys ({PREFIX!r}): curl "
                    "-F archive=@PHOTOS.zip.",
                )
        elif received.prefix is not None:
            raise _several_sources("a prefix and something else")
        parts.keep()
    finally:
        await run_in_threadpool(parts.close)
    return received


def discard(store: ObjectStore, received: ReceivedBatch) -> None:
    """Remove what was stored of the batch."""
    for file in (*received.files, received.archive):
        if file is not None and file.error is None:
            store.delete(file.key)


def batch_too_large(max_bytes: int) -> PlacewiseError:
    return TooLarge(
        "batch_too_large",
        f"The archive, or all files of the batch, are larger than {max_bytes} bytes "
        "(MAX_ARCHIVE_SIZE). Send them in several batches.",
        max_bytes=max_bytes,
    )


async def _read_manifest(request: Request) -> bytes:
    data = bytearray()
    async for piece in request.stream():
        data += piece
        if len(data) > MAX_MANIFEST_BYTES:
            raise _manifest_too_large()
    return bytes(data)


class _Parts:
    """The form's parts. `begin`, `data` and `end` only take note; `write` does what takes time, in
    another thread."""

    def __init__(self, store: ObjectStore, settings: Settings) -> None:
        self.batch = ReceivedBatch()
        self._store = store
        self._settings = settings
        self._name = ""
        self._manifest = bytearray()
        self._prefix = bytearray()
        self._files_bytes = 0
        self._todo: deque[tuple[UploadedFile, bytes | None]] = deque()
        """A file's next bytes, in order; None at its end."""
        self._file: UploadedFile | None = None
        self._passing: PassingFile | None = None
        self._writer: ObjectWriter | None = None
        self._kept = False

    def close(self) -> None:
        """Remove what is half written, and all of a body that was not whole."""
        self._give_up()
        if not self._kept:
            discard(self._store, self.batch)

    def keep(self) -> None:
        """The body was whole: what is stored stays."""
        self._kept = True

    def begin(self, name: str, filename: str | None) -> None:
        self._name = name
        if name == MANIFEST:
            if self.batch.manifest is not None:
                raise _several_sources("two manifests")
            self.batch.manifest = b""
        elif name == PREFIX:
            if self.batch.prefix is not None:
                raise _several_sources("two prefixes")
            self.batch.prefix = ""
        elif name not in (FILE, ARCHIVE):
            raise invalid_field(
                name,
                f"is unknown; known are {FILE}, {ARCHIVE}, {MANIFEST} and {PREFIX}. What is said "
                "of single photos belongs into the manifest",
            )
        elif filename is None:
            raise InvalidRequest(
                "no_file", f"The field {name!r} is no file: curl -F {name}=@PATH (with the @)."
            )
        elif name == FILE:
            if len(self.batch.files) == self._settings.max_batch_photos:
                raise too_many_photos(self._settings.max_batch_photos)
            self._file = UploadedFile(_label(filename), new_original_key())
            self.batch.files.append(self._file)
        else:
            if self.batch.archive is not None:
                raise _several_sources("two archives")
            self._file = self.batch.archive = UploadedFile(_label(filename), new_archive_key())
        if self.batch.archive and (self.batch.files or self.batch.manifest is not None):
            raise _several_sources("an archive and something else")

    def data(self, piece: bytes) -> None:
        if self._name == MANIFEST:
            self._manifest += piece
            if len(self._manifest) > MAX_MANIFEST_BYTES:
                raise _manifest_too_large()
            return
        if self._name == PREFIX:
            self._prefix += piece
            if len(self._prefix) > MAX_PREFIX_BYTES:
                raise invalid_field(PREFIX, f"has more than {MAX_PREFIX_BYTES} bytes")
            return
        self._files_bytes += len(piece)
        if self._files_bytes > self._settings.max_archive_size:
            raise batch_too_large(self._settings.max_archive_size)
        assert self._file is not None
        self._todo.append((self._file, piece))

    def end(self) -> None:
        if self._name == MANIFEST:
            self.batch.manifest = bytes(self._manifest)
        elif self._name == PREFIX:
            try:
                self.batch.prefix = self._prefix.decode()
            except UnicodeDecodeError:
                raise invalid_field(PREFIX, "is not UTF-8") from None
        else:
            assert self._file is not None
            self._todo.append((self._file, None))

    def write(self) -> None:
        """Write what has come since the last call."""
        while self._todo:
            file, piece = self._todo.popleft()
            if file.error is not None:
                continue  # read past
            try:
                self._finish(file) if piece is None else self._write(file, piece)
            except PlacewiseError as error:
                self._give_up()
                if file is self.batch.archive or error.status >= 500:
                    raise
                file.error = error

    def _write(self, file: UploadedFile, piece: bytes) -> None:
        if self._passing is None:
            self._passing = self._passing_file(file)
        self._passing.add(piece)
        if self._writer is None:
            self._writer = self._store.writer(file.key)
        self._writer.write(piece)

    def _finish(self, file: UploadedFile) -> None:
        if self._passing is None or self._writer is None:
            raise InvalidRequest("empty_file", f"The file {file.name!r} is empty.")
        self._passing.end()
        self._writer.commit()
        file.size_bytes, file.sha256 = self._passing.size_bytes, self._passing.sha256
        self._passing = self._writer = None

    def _give_up(self) -> None:
        if self._writer is not None:
            self._writer.abort()
        self._passing = self._writer = None

    def _passing_file(self, file: UploadedFile) -> PassingFile:
        if file is self.batch.archive:
            limit = self._settings.max_archive_size
            return PassingFile(limit, _check_archive, begin_bytes=SNIFFED_ARCHIVE_BYTES)
        return PassingFile(self._settings.max_file_size, check_photo_begin)


def too_many_photos(most: int) -> PlacewiseError:
    return TooLarge(
        "too_many_photos",
        f"A batch has at most {most} photos (MAX_BATCH_PHOTOS). Send several.",
    )


def _check_archive(begin: bytes) -> None:
    if sniff_archive(begin) is None:
        raise UnsupportedMedia(
            "unsupported_archive",
            f"By its content this is not {ACCEPTED_ARCHIVES}. Single photos belong into the "
            f"field {FILE!r}.",
        )


def _label(filename: str) -> str:
    """What the client calls the file, for people and for its line in the manifest."""
    return "".join(c for c in filename if c.isprintable())[:1000] or "photo"


def _several_sources(what: str) -> PlacewiseError:
    return InvalidRequest(
        "several_sources",
        f"The form has {what}. A batch is photos ({FILE!r}), to which one {MANIFEST!r} may be "
        f"added; or one {ARCHIVE!r}, with its table in it; or one {MANIFEST!r} of keys; or one "
        f"{PREFIX!r} of keys.",
    )


def _manifest_too_large() -> PlacewiseError:
    return TooLarge(
        "manifest_too_large", f"A manifest has at most {MAX_MANIFEST_BYTES} bytes. Send several."
    )
