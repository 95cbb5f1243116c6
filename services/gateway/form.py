"""Taking a multipart body apart while it arrives: its grammar and its limits, not its meaning."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from fastapi import Request
from python_multipart.exceptions import MultipartParseError
from python_multipart.multipart import MultipartParser, parse_options_header

from shared.errors import InvalidRequest, PlacewiseError, UnsupportedMedia

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
