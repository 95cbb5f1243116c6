"""Files that browsers load: read once, compressed once, named by their content.

The page on `/`, the descriptions of the API on `/docs` and `/redoc`, and what they load.

Everything comes from this server: Leaflet, Swagger UI and ReDoc are files of installed packages.
The one foreign address that a page may load from is that of MAP_TILES.
"""

from __future__ import annotations

import functools
import gzip
import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from urllib.parse import urlsplit

from fastapi import APIRouter, Request
from fastapi.responses import Response

from services.gateway.routes.health import ServiceResponse, service_info
from services.web import PAGE_FOLDER
from shared.config.settings import Settings
from shared.errors import NotFound

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


ASSET_PREFIX = "/console/"
HTML_PAGES = ("index.html", "docs.html", "redoc.html")
# From packages: the folder's name on this server, the package, the folder in it, and its files.
VENDORED_PACKAGES = (
    ("leaflet", "xstatic.pkg.leaflet", "data", ("leaflet.js", "leaflet.css")),
    (
        "api",
        "fastapi_offline",
        "static",
        ("swagger-ui-bundle.js", "swagger-ui.css", "redoc.standalone.js"),
    ),
)
# Swagger UI and ReDoc write style elements and run their search in a worker of a blob.
API_DOCS_CSP = "; style-src 'self' 'unsafe-inline'; worker-src blob:"


def create_web_page_router(settings: Settings) -> APIRouter:
    """The routes of the page."""
    assets = dict(_load_page_assets())
    pages = {name: assets.pop(name) for name in HTML_PAGES}
    assets["settings.json"] = StaticAsset.from_bytes(
        ".json", json.dumps(_page_settings(settings)).encode()
    )

    of_page = _page_headers(settings)
    policy = of_page["Content-Security-Policy"]
    of_descriptions = {**of_page, "Content-Security-Policy": policy + API_DOCS_CSP}
    router = APIRouter()

    @router.head("/", include_in_schema=False)
    @router.get("/", operation_id="service", response_model=ServiceResponse, tags=["operations"])
    def first(request: Request) -> Response:
        """What this is and where to look; to browsers, which ask for HTML, the page."""
        if "text/html" in request.headers.get("accept", ""):
            answer = pages["index.html"].to_response(request, of_page)
        else:
            answer = Response(service_info().model_dump_json(), media_type="application/json")
        answer.headers["Vary"] = "Accept, Accept-Encoding"
        return answer

    @router.api_route("/docs", methods=["GET", "HEAD"], include_in_schema=False)
    def docs(request: Request) -> Response:
        return pages["docs.html"].to_response(request, of_descriptions)

    @router.api_route("/redoc", methods=["GET", "HEAD"], include_in_schema=False)
    def redoc(request: Request) -> Response:
        return pages["redoc.html"].to_response(request, of_descriptions)

    @router.api_route(
        ASSET_PREFIX + "{path:path}", methods=["GET", "HEAD"], include_in_schema=False
    )
    def asset(request: Request, path: str) -> Response:
        found = assets.get(path)
        if found is None:
            raise NotFound("path_not_found", f"There is no {ASSET_PREFIX}{path}.")
        return found.to_response(request, {"X-Content-Type-Options": "nosniff"})

    return router


def _page_settings(settings: Settings) -> dict[str, str | int | None]:
    """Open to everyone, before any key: nothing of what is stored."""
    return {
        "map_tiles": settings.map_tiles,
        "map_attribution": settings.map_attribution,
        "max_file_size": settings.max_file_size,
    }


def _page_headers(settings: Settings) -> dict[str, str]:
    pictures = ["'self'", "blob:", "data:"]
    if settings.map_tiles is not None:
        tiles = urlsplit(settings.map_tiles)
        pictures.append(f"{tiles.scheme}://{tiles.netloc}")
    policy = {
        "default-src": "'self'",
        "img-src": " ".join(pictures),
        "base-uri": "'none'",
        "form-action": "'self'",
        "frame-ancestors": "'none'",
        "object-src": "'none'",
    }
    return {
        "Content-Security-Policy": "; ".join(f"{name} {value}" for name, value in policy.items()),
        # Tile servers want to know whose map it is, not which photo it shows.
        "Referrer-Policy": "strict-origin-when-cross-origin",
        "X-Content-Type-Options": "nosniff",
    }


@functools.cache
def _load_page_assets() -> dict[str, StaticAsset]:
    """All that pages load, by its path on this server: read, and compressed, once."""
    found = dict(load_assets(PAGE_FOLDER))
    for folder, package, inner, names in VENDORED_PACKAGES:
        there = Path(str(files(package))) / inner
        for name in names:
            found[f"{folder}/{name}"] = StaticAsset.from_bytes(
                Path(name).suffix, (there / name).read_bytes()
            )
    return found
