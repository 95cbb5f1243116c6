"""Files that browsers load: read once, compressed once, named by their content."""

from __future__ import annotations

import gzip
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from fastapi import Request
from fastapi.responses import Response

# Our own: the table of one machine differs from the next, and a module of a wrong type is not run.
MEDIA_TYPES = {
    ".css": "text/css; charset=utf-8",
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".png": "image/png",
    ".svg": "image/svg+xml",
}
COMPRESSIBLE_SUFFIXES = frozenset({".css", ".html", ".js", ".json", ".svg"})
# Kept by the browser, but asked for each time: a 304 is small, and a new release shows at once.
CACHE_CONTROL = "no-cache"


@dataclass(frozen=True, slots=True)
class StaticAsset:
    """One file as it is sent."""

    media_type: str
    body: bytes
    gzipped_body: bytes | None
    """The body in gzip; None where that gains nothing."""
    digest: str
    """Hexadecimal digest of the body."""

    @classmethod
    def from_bytes(cls, suffix: str, body: bytes) -> StaticAsset:
        """KeyError for a suffix that MEDIA_TYPES does not know."""
        zipped = gzip.compress(body, 9, mtime=0) if suffix in COMPRESSIBLE_SUFFIXES else None
        return cls(MEDIA_TYPES[suffix], body, zipped, hashlib.sha256(body).hexdigest()[:32])

    def to_response(self, request: Request, headers: dict[str, str]) -> Response:
        """200, or 304 to a browser that has this very content."""
        zipped = self.gzipped_body if _accepts_gzip(request) else None
        tag = f'"{self.digest}{"-gzip" if zipped else ""}"'
        own = {"Cache-Control": CACHE_CONTROL, "ETag": tag, "Vary": "Accept-Encoding", **headers}
        if tag in request.headers.get("if-none-match", ""):
            return Response(status_code=304, headers=own)
        if zipped:
            own["Content-Encoding"] = "gzip"
        return Response(zipped or self.body, media_type=self.media_type, headers=own)


def load_assets(folder: Path) -> Iterator[tuple[str, StaticAsset]]:
    """Every file below the folder whose kind browsers load, by its path from there."""
    for path in sorted(folder.rglob("*")):
        if path.suffix in MEDIA_TYPES:
            yield (
                path.relative_to(folder).as_posix(),
                StaticAsset.from_bytes(path.suffix, path.read_bytes()),
            )


def _accepts_gzip(request: Request) -> bool:
    offered = request.headers.get("accept-encoding", "").replace(" ", "").split(",")
    return any(one in ("gzip", "gzip;q=1.0") for one in offered)
