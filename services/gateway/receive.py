"""Taking a multipart body apart while it arrives: bounded memory, counted, hashed.

The file's bytes go straight into the object store; a body that is too large, or whose file is no
photo, is refused as soon as that is seen, without reading the rest.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import PurePosixPath, PureWindowsPath
from typing import Any, BinaryIO

from fastapi import Request
from python_multipart.exceptions import MultipartParseError
from python_multipart.multipart import MultipartParser, parse_options_header
from starlette.concurrency import run_in_threadpool

from shared.errors import InvalidRequest, PlacewiseError, TooLarge, UnsupportedMedia
from shared.objects import ObjectStore, ObjectWriter
from shared.photo_formats import ACCEPTED, SNIFFED_BYTES, sniff_media_type

FILE_FIELD = "file"
MAX_FIELDS_BYTES = 256 * 1024  # all text fields together
# What a body may hold beside the file: boundaries, part headers and the text fields.
OVERHEAD_BYTES = MAX_FIELDS_BYTES + 64 * 1024
# What is handed to the store at once: each time costs a change of thread.
WRITE_BYTES = 512 * 1024


@dataclass(slots=True)
class Received:
    """A file that lies whole under `key` of the object store, and the form's text fields."""

    key: str
    filename: str
    size_bytes: int
    sha256: str
    begin: bytes
    """The file's first bytes, as many as tell its format."""
    fields: dict[str, str] = field(default_factory=dict)
    whole: bytes | None = None
    """All of its bytes where they are few (WRITE_BYTES)."""

    def open(self, store: ObjectStore) -> BinaryIO:
        """The file, from memory or from the store."""
        return store.open(self.key) if self.whole is None else io.BytesIO(self.whole)


async def receive_file(
    request: Request,
    store: ObjectStore,
    key: str,
    max_bytes: int,
    check_begin: Callable[[bytes], object] = lambda begin: None,
) -> Received:
    """The form's file, stored under `key`, with its text fields.

    `check_begin` sees the first bytes before anything else is read and may raise. Raises
    InvalidRequest (no multipart body, no file, an empty file), TooLarge (`file_too_large`), and
    UnsupportedMedia for another kind of body. Nothing is left in the store when it raises.
    """
    form = _Form(_boundary(request), max_bytes, check_begin)
    declared = request.headers.get("content-length", "")
    if declared.isdigit() and int(declared) > max_bytes + OVERHEAD_BYTES:
        raise too_large(max_bytes)
    writer: ObjectWriter | None = None
    try:
        async for piece in request.stream():
            form.feed(piece)
            if form.pending_bytes >= WRITE_BYTES:
                if writer is None:
                    writer = await run_in_threadpool(store.writer, key)
                await run_in_threadpool(writer.write, form.take())
        form.finish()
        rest = form.take()
        whole = rest if writer is None else None
        if whole == b"":
            raise InvalidRequest("empty_file", f"The file in the field {FILE_FIELD!r} is empty.")
        await run_in_threadpool(_finish, store, key, writer, rest)
    except BaseException:
        if writer is not None:
            await run_in_threadpool(writer.abort)
        raise
    return Received(
        key=key,
        filename=form.filename,
        size_bytes=form.size_bytes,
        sha256=form.hash.hexdigest(),
        begin=form.begin,
        fields=form.fields,
        whole=whole,
    )


def _finish(store: ObjectStore, key: str, writer: ObjectWriter | None, rest: bytes) -> None:
    """Write what is left, and make the object visible."""
    if writer is None:
        store.put(key, rest)
        return
    writer.write(rest)
    writer.commit()


def describe_form(file: str, **fields: dict[str, Any]) -> dict[str, Any]:
    """The OpenAPI description of a form with a file: FastAPI sees only a stream."""
    properties = {
        FILE_FIELD: {"type": "string", "format": "binary", "description": file},
        **fields,
    }
    schema = {"type": "object", "required": [FILE_FIELD], "properties": properties}
    return {
        "requestBody": {"required": True, "content": {"multipart/form-data": {"schema": schema}}}
    }


def check_photo_begin(begin: bytes) -> str:
    """The photo's media type by its content; 415 for anything that is not accepted."""
    media_type = sniff_media_type(begin)
    if media_type is None:
        raise UnsupportedMedia(
            "unsupported_photo",
            f"By its content this is not a photo that Placewise reads: send {ACCEPTED}.",
        )
    return media_type


class _Form:
    """The parser's callbacks: collects fields, passes on the file's bytes."""

    def __init__(
        self, boundary: bytes, max_bytes: int, check_begin: Callable[[bytes], object]
    ) -> None:
        self.fields: dict[str, str] = {}
        self.filename = ""
        self.size_bytes = 0
        self.hash = hashlib.sha256()
        self.begin = b""
        self._max_bytes = max_bytes
        self._check_begin = check_begin
        self._checked = False
        self._file_seen = False
        self.pending_bytes = 0
        self._pending: list[bytes] = []
        self._body_bytes = 0
        self._fields_bytes = 0
        self._header_name = b""
        self._header_value = b""
        self._disposition = b""
        self._field: str | None = None
        self._value = bytearray()
        self._ended = False
        self._parser = MultipartParser(
            boundary,
            {
                "on_part_begin": self._on_part_begin,
                "on_header_field": self._on_header_field,
                "on_header_value": self._on_header_value,
                "on_header_end": self._on_header_end,
                "on_headers_finished": self._on_headers_finished,
                "on_part_data": self._on_part_data,
                "on_part_end": self._on_part_end,
                "on_end": self._on_end,
            },
        )

    def feed(self, piece: bytes) -> None:
        # Part headers and what follows the form count, too: no body goes on for ever.
        self._body_bytes += len(piece)
        if self._body_bytes > self._max_bytes + OVERHEAD_BYTES:
            raise too_large(self._max_bytes)
        try:
            self._parser.write(piece)
        except MultipartParseError as error:
            raise _malformed(str(error)) from error

    def take(self) -> bytes:
        """The file's bytes since the last call."""
        data = b"".join(self._pending)
        self._pending.clear()
        self.pending_bytes = 0
        return data

    def finish(self) -> None:
        """The body has ended: is it whole, and is there a file?"""
        if not self._ended:
            raise _malformed("it ends before its last boundary")
        if not self._file_seen:
            raise InvalidRequest(
                "no_file",
                f"The form has no file in the field {FILE_FIELD!r}: curl -F file=@PHOTO.",
            )

    def _on_part_begin(self) -> None:
        self._disposition = b""
        self._field = None
        self._value.clear()

    def _on_header_field(self, data: bytes, start: int, end: int) -> None:
        self._header_name += data[start:end]

    def _on_header_value(self, data: bytes, start: int, end: int) -> None:
        self._header_value += data[start:end]

    def _on_header_end(self) -> None:
        if self._header_name.lower() == b"content-disposition":
            self._disposition = self._header_value
        self._header_name = self._header_value = b""

    def _on_headers_finished(self) -> None:
        _, options = parse_options_header(self._disposition)
        name = options.get(b"name", b"").decode("utf-8", "replace")
        if not name:
            raise _malformed("a part has no name")
        if b"filename" not in options:
            self._field = name
            return
        if name != FILE_FIELD:
            raise InvalidRequest(
                "no_file",
                f"A file came in the field {name!r}; it belongs into {FILE_FIELD!r}.",
            )
        if self._file_seen:
            raise InvalidRequest("several_files", "This call takes one file; several came.")
        self._file_seen = True
        self.filename = base_name(options[b"filename"].decode("utf-8", "replace"))

    def _on_part_data(self, data: bytes, start: int, end: int) -> None:
        piece = data[start:end]
        if self._field is not None:
            self._fields_bytes += len(piece)
            if self._fields_bytes > MAX_FIELDS_BYTES:
                raise TooLarge("fields_too_large", "The form's text fields are too long.")
            self._value += piece
            return
        self.size_bytes += len(piece)
        if self.size_bytes > self._max_bytes:
            raise too_large(self._max_bytes)
        if len(self.begin) < SNIFFED_BYTES:
            self.begin = (self.begin + piece)[:SNIFFED_BYTES]
        if not self._checked and len(self.begin) == SNIFFED_BYTES:
            self._check()
        self.hash.update(piece)
        self._pending.append(piece)
        self.pending_bytes += len(piece)

    def _on_part_end(self) -> None:
        if self._field is not None:
            try:
                self.fields[self._field] = self._value.decode("utf-8")
            except UnicodeDecodeError:
                raise _malformed(f"the field {self._field!r} is not UTF-8") from None
        elif not self._checked and self.size_bytes:
            self._check()

    def _on_end(self) -> None:
        self._ended = True

    def _check(self) -> None:
        self._checked = True
        self._check_begin(self.begin)


def _boundary(request: Request) -> bytes:
    media_type, options = parse_options_header(request.headers.get("content-type", ""))
    if media_type != b"multipart/form-data":
        if not media_type:
            raise InvalidRequest("no_file", "The request has no body: curl -F file=@PHOTO.")
        raise UnsupportedMedia(
            "unsupported_body",
            f"Send the photo as multipart/form-data (curl -F file=@PHOTO), "
            f"not as {media_type.decode('latin-1')}.",
        )
    boundary = options.get(b"boundary", b"")
    if not 0 < len(boundary) <= 70:
        raise _malformed("its boundary is missing or too long")
    return boundary


def base_name(filename: str) -> str:
    """The last part of what the client calls the file, on either kind of system."""
    name = PurePosixPath(PureWindowsPath(filename).name).name
    return "".join(c for c in name if c.isprintable())[:255] or "photo"


def _malformed(reason: str) -> PlacewiseError:
    return InvalidRequest("malformed_body", f"The multipart body can't be read: {reason}.")


def too_large(max_bytes: int) -> PlacewiseError:
    return TooLarge(
        "file_too_large",
        f"The file is larger than {max_bytes} bytes (MAX_FILE_SIZE).",
        max_bytes=max_bytes,
    )
