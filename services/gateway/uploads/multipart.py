"""Streaming parser of multipart/form-data bodies, and the upload of a single file.

`receive_form_file` writes the file of a form to the object store while it is received: with bounded
memory, counted and hashed. Starlette's `request.form()` would spool the whole body to disk first.
A body that is too large, or whose file is not a photo, is refused without reading the rest.
"""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator, Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from fastapi import Request
from pydantic import BaseModel, ValidationError
from python_multipart.exceptions import MultipartParseError
from python_multipart.multipart import MultipartParser, parse_options_header
from starlette.concurrency import run_in_threadpool

from shared.errors import (
    InvalidRequest,
    PlacewiseError,
    TooLarge,
    UnsupportedMedia,
    invalid_field_error,
)
from shared.ingest.validation import StoredUpload, StreamValidator, base_name, file_too_large_error
from shared.storage import ObjectStore, ObjectWriter

MAX_FIELDS_BYTES = 256 * 1024  # all text fields together
# Allowed size of a body without its files: boundaries, part headers and text fields.
OVERHEAD_BYTES = MAX_FIELDS_BYTES + 64 * 1024

Form = TypeVar("Form", bound=BaseModel)


class PartHandler(Protocol):
    """Receives the parts of a form; exceptions that it raises abort the parsing."""

    def begin(self, name: str, filename: str | None) -> None:
        """A part begins; `filename` is None if it is not a file."""

    def data(self, piece: bytes) -> None:
        """The next bytes of the part."""

    def end(self) -> None:
        """The part is complete."""


class MultipartFormParser:
    """Incremental parser of a multipart form; passes the parts to a `PartHandler`."""

    def __init__(
        self,
        request: Request,
        handler: PartHandler,
        max_bytes: int,
        too_large: Callable[[], Exception],
    ) -> None:
        """Create the parser for the body of a request.

        Args:
            request: Its headers give the boundary and the declared size.
            too_large: Builds the exception for a larger body.

        Raises:
            InvalidRequest: `no_file`, `malformed_body`.
            UnsupportedMedia: `unsupported_body`.
            Exception: That of `too_large`, if Content-Length exceeds `max_bytes`.
        """
        self._max_bytes = max_bytes
        self._too_large = too_large
        self._handler = handler
        self._body_bytes = 0
        self._header_name = b""
        self._header_value = b""
        self._disposition = b""
        self._ended = False
        self._parser = MultipartParser(
            _parse_boundary(request),
            {
                "on_header_field": self._on_header_field,
                "on_header_value": self._on_header_value,
                "on_header_end": self._on_header_end,
                "on_headers_finished": self._on_headers_finished,
                "on_part_data": self._on_part_data,
                "on_part_end": handler.end,
                "on_end": self._on_end,
            },
        )
        declared = request.headers.get("content-length", "")
        if declared.isdigit() and int(declared) > max_bytes:
            raise too_large()

    def feed(self, piece: bytes) -> None:
        """Parse the next bytes of the body."""
        # The whole body counts, with part headers and the epilogue: it can't be endless.
        self._body_bytes += len(piece)
        if self._body_bytes > self._max_bytes:
            raise self._too_large()
        try:
            self._parser.write(piece)
        except MultipartParseError as error:
            raise _malformed_body_error(str(error)) from error

    def finish(self) -> None:
        """Raise InvalidRequest (`malformed_body`) if the body is incomplete."""
        if not self._ended:
            raise _malformed_body_error("the body ends before the last boundary")

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
        self._disposition = b""
        name = options.get(b"name", b"").decode("utf-8", "replace")
        if not name:
            raise _malformed_body_error("a part has no name")
        filename = options.get(b"filename")
        self._handler.begin(name, None if filename is None else filename.decode("utf-8", "replace"))

    def _on_part_data(self, data: bytes, start: int, end: int) -> None:
        self._handler.data(data[start:end])

    def _on_end(self) -> None:
        self._ended = True


def _malformed_body_error(reason: str) -> PlacewiseError:
    """Build the 400 error for a body that can't be parsed."""
    return InvalidRequest("malformed_body", f"The multipart body can't be read: {reason}.")


def _parse_boundary(request: Request) -> bytes:
    media_type, options = parse_options_header(request.headers.get("content-type", ""))
    if media_type != b"multipart/form-data":
        if not media_type:
            raise InvalidRequest(
                "no_file", "The request has no body. Send a form: curl -F file=@PHOTO."
            )
        raise UnsupportedMedia(
            "unsupported_body",
            "Send the photo as multipart/form-data (curl -F file=@PHOTO), "
            f"not as {media_type.decode('latin-1')}.",
        )
    boundary = options.get(b"boundary", b"")
    if not 0 < len(boundary) <= 70:
        raise _malformed_body_error("the boundary is missing or too long")
    return boundary


FILE_FIELD = "file"
# Size of one write to the store: each write is a switch to a worker thread.
STORE_WRITE_BYTES = 512 * 1024


@dataclass(frozen=True, slots=True)
class FormFile:
    """A completely received file; its object is visible in the store after `complete`."""

    upload: StoredUpload
    _store: ObjectStore
    _writer: ObjectWriter | None
    _rest: bytes

    def complete(self) -> StoredUpload:
        """Write what is left and make the object visible. Blocks."""
        if self._writer is None:
            self._store.put(self.upload.key, self._rest)
        else:
            self._writer.write(self._rest)
            self._writer.commit()
        return self.upload


@contextlib.asynccontextmanager
async def receive_form_file(
    request: Request,
    store: ObjectStore,
    make_key: Callable[[str], str],
    max_bytes: int,
    check_begin: Callable[[bytes], object] = lambda begin: None,
    *,
    too_large: Callable[[int], PlacewiseError] = file_too_large_error,
) -> AsyncIterator[FormFile]:
    """Receive the file of a form, and write it to the object store meanwhile.

    The block completes the object, best in the worker thread that uses it next: a change of
    threads costs as much as a statement. Nothing is left in the store if it raises before.

    Args:
        make_key: Makes the object key of the file from its name.
        check_begin: Called with the first bytes before the rest is read; may raise.
        too_large: Builds the exception for a file of more than `max_bytes`.

    Raises:
        InvalidRequest: No multipart body, no file, several files or an empty file.
        TooLarge: `file_too_large`, `fields_too_large`.
        UnsupportedMedia: The body is not multipart/form-data.
    """
    parts = _SingleFileHandler(StreamValidator(max_bytes, check_begin, too_large=too_large))
    form = MultipartFormParser(
        request, parts, max_bytes + OVERHEAD_BYTES, lambda: too_large(max_bytes)
    )
    key = ""
    writer: ObjectWriter | None = None
    try:
        async for piece in request.stream():
            form.feed(piece)
            if parts.pending_bytes >= STORE_WRITE_BYTES:
                if writer is None:
                    key = make_key(parts.filename)
                    writer = await run_in_threadpool(store.writer, key)
                await run_in_threadpool(writer.write, parts.take_pending())
        form.finish()
        parts.require_file()
        rest = parts.take_pending()
        upload = StoredUpload(
            key=key or make_key(parts.filename),
            filename=parts.filename,
            size_bytes=parts.file.size_bytes,
            sha256=parts.file.sha256,
            first_bytes=parts.file.first_bytes,
            fields=parts.fields,
            content=rest if writer is None else None,
        )
        yield FormFile(upload, store, writer, rest)
    except BaseException:
        if writer is not None:
            await run_in_threadpool(writer.abort)
        raise


def parse_form(model: type[Form], fields: dict[str, str]) -> Form:
    """Parse the text fields of a form; an empty field counts as missing.

    Raises:
        Unprocessable: `invalid_field`.
    """
    values = {name: value.strip() for name, value in fields.items() if value.strip()}
    try:
        return model.model_validate(values)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        name = str(first["loc"][0]) if first["loc"] else "form"
        raise invalid_field_error(name, first["msg"].removeprefix("Value error, ")) from None


def multipart_schema(
    file: str, required: Sequence[str] = (), **fields: dict[str, Any]
) -> dict[str, Any]:
    """Return the OpenAPI request body of a form with a file, for `openapi_extra`.

    FastAPI can't derive it, because the routes read the body as a stream.

    Args:
        file: Description of the file.
        fields: JSON schemas of the text fields.
    """
    properties = {FILE_FIELD: {"type": "string", "format": "binary", "description": file}, **fields}
    schema = {"type": "object", "required": [FILE_FIELD, *required], "properties": properties}
    return {
        "requestBody": {"required": True, "content": {"multipart/form-data": {"schema": schema}}}
    }


class _SingleFileHandler:
    """Collects the text fields and buffers the bytes of the file."""

    def __init__(self, file: StreamValidator) -> None:
        self.file = file
        self.filename = ""
        self.fields: dict[str, str] = {}
        self._file_seen = False
        self._field: str | None = None
        self._value = bytearray()
        self._fields_bytes = 0
        self.pending_bytes = 0
        self._pending: list[bytes] = []

    def take_pending(self) -> bytes:
        """Return the bytes of the file since the last call."""
        data = b"".join(self._pending)
        self._pending.clear()
        self.pending_bytes = 0
        return data

    def require_file(self) -> None:
        """Raise InvalidRequest (`no_file`, `empty_file`) if the form has no file, or no bytes."""
        if not self._file_seen:
            raise InvalidRequest(
                "no_file", f"The form has no file in the field {FILE_FIELD!r}: curl -F file=@PHOTO."
            )
        if not self.file.size_bytes:
            raise InvalidRequest("empty_file", "The file is empty.")

    def begin(self, name: str, filename: str | None) -> None:
        if filename is None:
            self._field = name
            return
        self._field = None
        if name != FILE_FIELD:
            raise InvalidRequest(
                "no_file",
                f"The file is in the form field {name!r}; it is expected in {FILE_FIELD!r}.",
            )
        if self._file_seen:
            raise InvalidRequest("several_files", "The form has several files; send one.")
        self._file_seen = True
        self.filename = base_name(filename)

    def data(self, piece: bytes) -> None:
        if self._field is None:
            self.file.add(piece)
            self._pending.append(piece)
            self.pending_bytes += len(piece)
            return
        self._fields_bytes += len(piece)
        if self._fields_bytes > MAX_FIELDS_BYTES:
            raise TooLarge(
                "fields_too_large",
                f"The text fields of the form have more than {MAX_FIELDS_BYTES} bytes.",
            )
        self._value += piece

    def end(self) -> None:
        if self._field is None:
            self.file.end()
            return
        if self._field in self.fields:
            raise _malformed_body_error(f"the field {self._field!r} is there twice; use commas")
        try:
            self.fields[self._field] = self._value.decode("utf-8")
        except UnicodeDecodeError:
            raise _malformed_body_error(f"the field {self._field!r} is not UTF-8") from None
        self._value.clear()
