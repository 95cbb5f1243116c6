"""Taking a multipart body apart while it arrives: its grammar and its limits, not its meaning.

One file of a form, stored while it arrives: bounded memory, counted, hashed.

The file's bytes go straight into the object store; a body that is too large, or whose file is no
photo, is refused as soon as that is seen, without reading the rest.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

from fastapi import Request
from python_multipart.exceptions import MultipartParseError
from python_multipart.multipart import MultipartParser, parse_options_header
from starlette.concurrency import run_in_threadpool

from shared.errors import InvalidRequest, PlacewiseError, TooLarge, UnsupportedMedia
from shared.ingest.validation import StoredUpload, StreamValidator, base_name, file_too_large_error
from shared.storage import ObjectStore, ObjectWriter

MAX_FIELDS_BYTES = 256 * 1024  # all text fields together
# What a body may hold beside its files: boundaries, part headers and the text fields.
OVERHEAD_BYTES = MAX_FIELDS_BYTES + 64 * 1024


class PartHandler(Protocol):
    """Who takes the parts; what it raises ends the reading."""

    def begin(self, name: str, filename: str | None) -> None:
        """A part begins; `filename` is None for one that is no file."""

    def data(self, piece: bytes) -> None:
        """The next bytes of the part."""

    def end(self) -> None:
        """The part is whole."""


class MultipartFormParser:
    """A form that is fed piece by piece and calls `parts`."""

    def __init__(
        self,
        request: Request,
        handler: PartHandler,
        max_bytes: int,
        too_large: Callable[[], Exception],
    ) -> None:
        """`max_bytes` of body, for which `too_large` makes the refusal.

        Raises InvalidRequest (`no_file`, `malformed_body`), UnsupportedMedia (`unsupported_body`),
        and the refusal of a body that is declared to be too large.
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
                "on_part_begin": self._on_part_begin,
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
        """The next bytes of the body."""
        # Part headers and what follows the form count, too: no body goes on for ever.
        self._body_bytes += len(piece)
        if self._body_bytes > self._max_bytes:
            raise self._too_large()
        try:
            self._parser.write(piece)
        except MultipartParseError as error:
            raise malformed_body_error(str(error)) from error

    def finish(self) -> None:
        """The body has ended: is it whole?"""
        if not self._ended:
            raise malformed_body_error("it ends before its last boundary")

    def _on_part_begin(self) -> None:
        self._disposition = b""

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
            raise malformed_body_error("a part has no name")
        filename = options.get(b"filename")
        self._handler.begin(name, None if filename is None else filename.decode("utf-8", "replace"))

    def _on_part_data(self, data: bytes, start: int, end: int) -> None:
        self._handler.data(data[start:end])

    def _on_end(self) -> None:
        self._ended = True


def malformed_body_error(reason: str) -> PlacewiseError:
    return InvalidRequest("malformed_body", f"The multipart body can't be read: {reason}.")


def body_media_type(request: Request) -> str:
    """The body's media type, in small letters and without parameters; "" when none is said."""
    media_type, _ = parse_options_header(request.headers.get("content-type", ""))
    return media_type.decode("latin-1").lower()


def _parse_boundary(request: Request) -> bytes:
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
        raise malformed_body_error("its boundary is missing or too long")
    return boundary


FILE_FIELD = "file"
# What is handed to the store at once: each time costs a change of thread.
STORE_WRITE_BYTES = 512 * 1024


async def store_form_file(
    request: Request,
    store: ObjectStore,
    key: str,
    max_bytes: int,
    check_begin: Callable[[bytes], object] = lambda begin: None,
    *,
    too_large: Callable[[int], PlacewiseError] = file_too_large_error,
) -> StoredUpload:
    """The form's file, stored under `key`, with its text fields.

    `check_begin` sees the first bytes before anything else is read and may raise; `too_large` makes
    the refusal of more than `max_bytes`. Raises InvalidRequest (no multipart body, no file, an
    empty file), TooLarge (`file_too_large_error`), and UnsupportedMedia for another kind of
    body. Nothing
    is left in the store when it raises.
    """
    parts = _SingleFileHandler(StreamValidator(max_bytes, check_begin, too_large=too_large))
    form = MultipartFormParser(
        request, parts, max_bytes + OVERHEAD_BYTES, lambda: too_large(max_bytes)
    )
    writer: ObjectWriter | None = None
    try:
        async for piece in request.stream():
            form.feed(piece)
            if parts.pending_bytes >= STORE_WRITE_BYTES:
                if writer is None:
                    writer = await run_in_threadpool(store.writer, key)
                await run_in_threadpool(writer.write, parts.take_pending())
        form.finish()
        parts.require_file()
        rest = parts.take_pending()
        whole = rest if writer is None else None
        if whole == b"":
            raise InvalidRequest("empty_file", f"The file in the field {FILE_FIELD!r} is empty.")
        await run_in_threadpool(_finish_object, store, key, writer, rest)
    except BaseException:
        if writer is not None:
            await run_in_threadpool(writer.abort)
        raise
    return StoredUpload(
        key=key,
        filename=parts.filename,
        size_bytes=parts.file.size_bytes,
        sha256=parts.file.sha256,
        first_bytes=parts.file.first_bytes,
        fields=parts.fields,
        content=whole,
    )


def _finish_object(store: ObjectStore, key: str, writer: ObjectWriter | None, rest: bytes) -> None:
    """Write what is left, and make the object visible."""
    if writer is None:
        store.put(key, rest)
        return
    writer.write(rest)
    writer.commit()


def multipart_schema(
    file: str, required: Sequence[str] = (), **fields: dict[str, Any]
) -> dict[str, Any]:
    """The OpenAPI description of a form with a file, and of `fields`, of which some are `required`,
    too: FastAPI sees only a stream.
    """
    properties = {
        FILE_FIELD: {"type": "string", "format": "binary", "description": file},
        **fields,
    }
    schema = {"type": "object", "required": [FILE_FIELD, *required], "properties": properties}
    return {
        "requestBody": {"required": True, "content": {"multipart/form-data": {"schema": schema}}}
    }


class _SingleFileHandler:
    """Collects the text fields, passes on the file's bytes."""

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
        """The file's bytes since the last call."""
        data = b"".join(self._pending)
        self._pending.clear()
        self.pending_bytes = 0
        return data

    def require_file(self) -> None:
        """Was there a file in the form?"""
        if not self._file_seen:
            raise InvalidRequest(
                "no_file",
                f"The form has no file in the field {FILE_FIELD!r}: curl -F file=@PHOTO.",
            )

    def begin(self, name: str, filename: str | None) -> None:
        if filename is None:
            self._field = name
            return
        self._field = None
        if name != FILE_FIELD:
            raise InvalidRequest(
                "no_file",
                f"A file came in the field {name!r}; it belongs into {FILE_FIELD!r}.",
            )
        if self._file_seen:
            raise InvalidRequest("several_files", "This call takes one file; several came.")
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
            raise TooLarge("fields_too_large", "The form's text fields are too long.")
        self._value += piece

    def end(self) -> None:
        if self._field is None:
            self.file.end()
            return
        try:
            self.fields[self._field] = self._value.decode("utf-8")
        except UnicodeDecodeError:
            raise malformed_body_error(f"the field {self._field!r} is not UTF-8") from None
        self._value.clear()
