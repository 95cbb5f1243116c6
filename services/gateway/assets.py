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
COMPRESSED = frozenset({".css", ".html", ".js", ".json", ".svg"})
# Kept by the browser, but asked for each time: a 304 is small, and a new release shows at once.
CACHE = "no-cache"


@dataclass(frozen=True, slots=True)
class Asset:
    """One file as it is sent."""

    media_type: str
    body: bytes
    zipped: bytes | None
    """The body in gzip; None where that gains nothing."""
    tag: str
    """Hexadecimal digest of the body."""

    @classmethod
    def of(cls, suffix: str, body: bytes) -> Asset:
        """KeyError for a suffix that MEDIA_TYPES does not know."""
        zipped = gzip.compress(body, 9, mtime=0) if suffix in COMPRESSED else None
        return cls(MEDIA_TYPES[suffix], body, zipped, hashlib.sha256(body).hexdigest()[:32])

    def answer(self, request: Request, headers: dict[str, str]) -> Response:
        """200, or 304 to a browser that has this very content."""
        zipped = self.zipped if _takes_gzip(request) else None
        tag = f'"{self.tag}{"-gzip" if zipped else ""}"'
        own = {"Cache-Control": CACHE, "ETag": tag, "Vary": "Accept-Encoding", **headers}
        if tag in request.headers.get("if-none-match", ""):
            return Response(status_code=304, headers=own)
        if zipped:
            own["Content-Encoding"] = "gzip"
        return Response(zipped or self.body, media_type=self.media_type, headers=own)


def read_assets(folder: Path) -> Iterator[tuple[str, Asset]]:
    """Every file below the folder whose kind browsers load, by its path from there."""
    for path in sorted(folder.rglob("*")):
        if path.suffix in MEDIA_TYPES:
            yield path.relative_to(folder).as_posix(), Asset.of(path.suffix, path.read_bytes())


def _takes_gzip(request: Request) -> bool:
    offered = request.headers.get("accept-encoding", "").replace(" ", "").split(",")
    return any(one in ("gzip", "gzip;q=1.0") for one in offered)
