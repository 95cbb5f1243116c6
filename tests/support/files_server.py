"""A local HTTP server of a few files: with ranges, and with faults on demand.

It also answers as the Hugging Face hub does: `/OWNER/NAME/resolve/main/FILE` with the headers that
its client reads.
"""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import ThreadingHTTPServer
from typing import Any

from tests.support.fake_server import QuietHandler, serving

HUB_COMMIT = "9" * 40


@dataclass
class FilesServer:
    """Its files, its faults, and the requests so far."""

    url: str = ""
    files: dict[str, bytes] = field(default_factory=dict)
    """Content by path."""
    promised: dict[str, bytes] = field(default_factory=dict)
    """What a path's hash is taken of instead of its content."""
    break_after: list[int] = field(default_factory=list)
    """Bytes after which the next answers break off, each once."""
    ranges: bool = True
    """Whether it has strong ETags and sends parts."""
    refuse: list[int] = field(default_factory=list)
    """Statuses of the next answers."""
    requests: list[tuple[str, str | None]] = field(default_factory=list)
    """Path and `Range` of each GET."""

    def etag(self, path: str) -> str:
        return hashlib.sha256(self.promised.get(path, self.files[path])).hexdigest()


class _Handler(QuietHandler):
    protocol_version = "HTTP/1.1"
    server: Any

    def do_HEAD(self) -> None:  # noqa: N802
        self._answer(send=False)

    def do_GET(self) -> None:  # noqa: N802
        self._answer(send=True)

    def _answer(self, *, send: bool) -> None:
        shown: FilesServer = self.server.shown
        byte_range = self.headers.get("Range")
        if send:
            shown.requests.append((self.path, byte_range))
            if shown.refuse:
                self.send_error(shown.refuse.pop(0))
                return
        data = shown.files.get(self.path)
        if data is None:
            self.send_error(404)
            return
        etag = f'"{shown.etag(self.path)}"'
        begin, status = 0, 200
        if send and shown.ranges and byte_range and self.headers.get("If-Range") in (None, etag):
            begin, status = int(byte_range.removeprefix("bytes=").rstrip("-")), 206
        if status == 206 and begin >= len(data):
            self.send_response(416)
            self.send_header("Content-Range", f"bytes */{len(data)}")
            self.send_header("Content-Length", "0")
            self.end_headers()
            return
        self.send_response(status)
        if shown.ranges:
            self.send_header("ETag", etag)
        if status == 206:
            self.send_header("Content-Range", f"bytes {begin}-{len(data) - 1}/{len(data)}")
        self.send_header("Content-Length", str(len(data) - begin))
        self.send_header("X-Repo-Commit", HUB_COMMIT)
        self.end_headers()
        if not send:
            return
        if shown.break_after:
            self.wfile.write(data[begin : begin + shown.break_after.pop(0)])
            self.wfile.flush()
            self.close_connection = True
            self.connection.shutdown(2)
            return
        self.wfile.write(data[begin:])


@contextlib.contextmanager
def files_server() -> Iterator[FilesServer]:
    """A server on a free port until the block ends."""
    with ThreadingHTTPServer(("127.0.0.1", 0), _Handler) as server:
        shown = FilesServer(url=f"http://127.0.0.1:{server.server_port}")
        server.shown = shown  # type: ignore[attr-defined]
        with serving(server):
            yield shown
