"""The web page on `/`, the API documentation on `/docs` and `/redoc`, and their static assets.

All assets come from this server: Leaflet, Swagger UI and ReDoc are files of installed packages. The
only other origin that a page may load from is that of MAP_TILES: images, and only once the user has
agreed.

Assets are read once, compressed on first use, and revalidated by an ETag of their content.
Starlette's StaticFiles derives the ETag from the file's modification time, which differs between
replicas, and does not serve precompressed files.
"""

from __future__ import annotations

import functools
import gzip
import hashlib
import io
import json
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Annotated
from urllib.parse import urlsplit

import segno
from fastapi import APIRouter, Query, Request
from fastapi.responses import Response

from services.gateway.routes.health import ServiceResponse, service_info
from services.web import PAGE_FOLDER
from shared.config.settings import Settings
from shared.errors import NotFound

# Not `mimetypes`: its table depends on the machine, and browsers refuse modules of a wrong type.
MEDIA_TYPES = {
    ".css": "text/css; charset=utf-8",
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".png": "image/png",
    ".svg": "image/svg+xml",
}
COMPRESSIBLE_SUFFIXES = frozenset({".css", ".html", ".js", ".json", ".svg"})
# Browsers cache, but revalidate each time: a 304 is small, and a new release is visible at once.
CACHE_CONTROL = "no-cache"


@dataclass(frozen=True)
class _StaticAsset:
    """A static file."""

    suffix: str
    """Suffix of the file, in MEDIA_TYPES."""
    body: bytes

    @functools.cached_property
    def gzipped_body(self) -> bytes | None:
        """The gzip-compressed body; None for formats that are compressed already."""
        # On first use: compressing all assets would take 0.3 s of each start.
        is_compressible = self.suffix in COMPRESSIBLE_SUFFIXES
        return gzip.compress(self.body, 9, mtime=0) if is_compressible else None

    @functools.cached_property
    def digest(self) -> str:
        """First 32 hexadecimal digits of the SHA-256 of the body."""
        return hashlib.sha256(self.body).hexdigest()[:32]

    def to_response(self, request: Request, headers: dict[str, str]) -> Response:
        """Build the response: 200, or 304 if the browser has the same content."""
        zipped = self.gzipped_body if _accepts_gzip(request) else None
        tag = f'"{self.digest}{"-gzip" if zipped else ""}"'
        all_headers = {
            "Cache-Control": CACHE_CONTROL,
            "ETag": tag,
            "Vary": "Accept-Encoding",
            **headers,
        }
        if tag in request.headers.get("if-none-match", ""):
            return Response(status_code=304, headers=all_headers)
        if zipped:
            all_headers["Content-Encoding"] = "gzip"
        return Response(
            zipped or self.body, media_type=MEDIA_TYPES[self.suffix], headers=all_headers
        )


def _load_assets(folder: Path) -> Iterator[tuple[str, _StaticAsset]]:
    """Yield the files below `folder` with a suffix in MEDIA_TYPES, with their relative paths."""
    for path in sorted(folder.rglob("*")):
        if path.suffix in MEDIA_TYPES:
            yield path.relative_to(folder).as_posix(), _StaticAsset(path.suffix, path.read_bytes())


def _accepts_gzip(request: Request) -> bool:
    encodings = request.headers.get("accept-encoding", "").replace(" ", "").split(",")
    return any(encoding in ("gzip", "gzip;q=1.0") for encoding in encodings)


ASSET_PREFIX = "/console/"
HTML_PAGES = ("index.html", "docs.html", "redoc.html")
# Assets of installed packages: URL folder, package, folder in the package, file names.
VENDORED_PACKAGES = (
    ("leaflet", "xstatic.pkg.leaflet", "data", ("leaflet.js", "leaflet.css")),
    (
        "api",
        "fastapi_offline",
        "static",
        ("swagger-ui-bundle.js", "swagger-ui.css", "redoc.standalone.js"),
    ),
)
# Swagger UI and ReDoc insert style elements and run their search in a worker from a blob URL.
API_DOCS_CSP = "; style-src 'self' 'unsafe-inline'; worker-src blob:"


def create_web_page_router(settings: Settings, lan_url: str | None = None) -> APIRouter:
    """Create the routes of the web page, the API documentation and the assets.

    `lan_url` is the URL of this server for other devices of the network, if it is known.
    """
    assets = dict(_load_page_assets())
    pages = {name: assets.pop(name) for name in HTML_PAGES}
    assets["settings.json"] = _StaticAsset(
        ".json", json.dumps(_page_settings(settings, lan_url)).encode()
    )

    page_headers = _page_headers(settings)
    policy = page_headers["Content-Security-Policy"]
    docs_headers = {**page_headers, "Content-Security-Policy": policy + API_DOCS_CSP}
    router = APIRouter()

    @router.head("/", include_in_schema=False)
    @router.get("/", operation_id="service", response_model=ServiceResponse, tags=["operations"])
    def root(request: Request) -> Response:
        """Name, version and links of the service as JSON; the web page for browsers."""
        if "text/html" in request.headers.get("accept", ""):
            response = pages["index.html"].to_response(request, page_headers)
        else:
            response = Response(service_info().model_dump_json(), media_type="application/json")
        response.headers["Vary"] = "Accept, Accept-Encoding"
        return response

    @router.api_route("/docs", methods=["GET", "HEAD"], include_in_schema=False)
    def docs(request: Request) -> Response:
        return pages["docs.html"].to_response(request, docs_headers)

    @router.api_route("/redoc", methods=["GET", "HEAD"], include_in_schema=False)
    def redoc(request: Request) -> Response:
        return pages["redoc.html"].to_response(request, docs_headers)

    @router.api_route(ASSET_PREFIX + "qr.svg", methods=["GET", "HEAD"], include_in_schema=False)
    def qr_code(
        url: Annotated[str, Query(max_length=200, pattern=r"^https?://[!-~]+$")],
    ) -> Response:
        """A QR code of the page's own URL, for the camera of a phone."""
        image = io.BytesIO()
        segno.make_qr(url).save(image, kind="svg", border=2, dark="#000", light="#fff", scale=6)
        headers = {"X-Content-Type-Options": "nosniff"}
        return Response(image.getvalue(), media_type=MEDIA_TYPES[".svg"], headers=headers)

    @router.api_route(
        ASSET_PREFIX + "{path:path}", methods=["GET", "HEAD"], include_in_schema=False
    )
    def asset(request: Request, path: str) -> Response:
        static_asset = assets.get(path)
        if static_asset is None:
            raise NotFound("path_not_found", f"There is no {ASSET_PREFIX}{path}.")
        return static_asset.to_response(request, {"X-Content-Type-Options": "nosniff"})

    return router


def _page_settings(settings: Settings, lan_url: str | None) -> dict[str, str | int | None]:
    """Settings of the page. Served without a key: must not expose stored data."""
    return {
        "map_tiles": settings.map_tiles,
        "map_attribution": settings.tile_attribution,
        "max_file_size": settings.max_file_size,
        "lan_url": lan_url,
    }


def _page_headers(settings: Settings) -> dict[str, str]:
    image_sources = ["'self'", "blob:", "data:"]
    if settings.map_tiles is not None:
        tiles = urlsplit(settings.map_tiles)
        image_sources.append(f"{tiles.scheme}://{tiles.netloc}")
    policy = {
        "default-src": "'self'",
        "img-src": " ".join(image_sources),
        "base-uri": "'none'",
        "form-action": "'self'",
        "frame-ancestors": "'none'",
        "object-src": "'none'",
    }
    return {
        "Content-Security-Policy": "; ".join(f"{name} {value}" for name, value in policy.items()),
        # Tile servers require the origin of the page, but must not see which photo it shows.
        "Referrer-Policy": "strict-origin-when-cross-origin",
        "X-Content-Type-Options": "nosniff",
    }


@functools.cache
def _load_page_assets() -> dict[str, _StaticAsset]:
    """All assets by their URL path below ASSET_PREFIX."""
    assets = dict(_load_assets(PAGE_FOLDER))
    for url_folder, package, package_folder, names in VENDORED_PACKAGES:
        source = Path(str(files(package))) / package_folder
        for name in names:
            file = source / name
            assets[f"{url_folder}/{name}"] = _StaticAsset(file.suffix, file.read_bytes())
    return assets
