"""The web page on `/`, the API documentation on `/docs` and `/redoc`, and their static assets.

All assets come from this server: Leaflet, Swagger UI and ReDoc are files of installed packages. The
only other origin that a page may load from is that of MAP_TILES: images, and only once the user has
agreed, or the operator by setting it.
"""

from __future__ import annotations

import io
import mimetypes
from typing import Annotated, Any
from urllib.parse import urlsplit

import segno
from fastapi import FastAPI, Query, Request
from fastapi.responses import FileResponse, Response
from fastapi.staticfiles import StaticFiles
from starlette.middleware.gzip import GZipMiddleware

from services.gateway.routes.health import ServiceResponse, service_info
from services.web import HTML_FOLDER, PAGE_FOLDER
from shared.catalog.jobs import STATUS_PAGE_JOBS
from shared.config.settings import Settings

# Browsers cache, but revalidate each time: a 304 is small, and a new release is visible at once.
CACHE_CONTROL = "no-cache"
# Browsers refuse modules of a wrong type, and the table of types depends on the machine.
mimetypes.add_type("text/javascript", ".js")


class _Assets(StaticFiles):
    """Static files that browsers revalidate."""

    def file_response(self, *args: Any, **kwargs: Any) -> Response:
        response = super().file_response(*args, **kwargs)
        response.headers["Cache-Control"] = CACHE_CONTROL
        return response


ASSET_PREFIX = "/console/"
# Folder below ASSET_PREFIX -> an installed package and its folder of assets.
VENDORED_PACKAGES = {
    "leaflet": ("xstatic.pkg.leaflet", "data"),
    "api": ("fastapi_offline", "static"),
}
# Swagger UI and ReDoc insert style elements and run their search in a worker from a blob URL.
API_DOCS_CSP = "; style-src 'self' 'unsafe-inline'; worker-src blob:"


def add_web_page(app: FastAPI, settings: Settings, lan_url: str | None = None) -> None:
    """Add the web page, the API documentation and the assets to the application.

    `lan_url` is the URL of this server for other devices of the network, if it is known.
    """
    page_headers = _page_headers(settings)
    policy = page_headers["Content-Security-Policy"]
    docs_headers = {**page_headers, "Content-Security-Policy": policy + API_DOCS_CSP}

    @app.head("/", include_in_schema=False)
    @app.get("/", operation_id="service", response_model=ServiceResponse, tags=["operations"])
    def root(request: Request) -> Response:
        """Name, version and links of the service as JSON; the web page for browsers."""
        response: Response
        if "text/html" in request.headers.get("accept", ""):
            response = FileResponse(HTML_FOLDER / "index.html", headers=page_headers)
        else:
            response = Response(service_info().model_dump_json(), media_type="application/json")
        response.headers["Vary"] = "Accept"
        return response

    @app.api_route("/docs", methods=["GET", "HEAD"], include_in_schema=False)
    def docs() -> Response:
        return FileResponse(HTML_FOLDER / "docs.html", headers=docs_headers)

    @app.api_route("/redoc", methods=["GET", "HEAD"], include_in_schema=False)
    def redoc() -> Response:
        return FileResponse(HTML_FOLDER / "redoc.html", headers=docs_headers)

    @app.api_route(ASSET_PREFIX + "qr.svg", methods=["GET", "HEAD"], include_in_schema=False)
    def qr_code(
        url: Annotated[str, Query(max_length=200, pattern=r"^https?://[!-~]+$")],
    ) -> Response:
        """A QR code of the page's own URL, for the camera of a phone."""
        image = io.BytesIO()
        segno.make_qr(url).save(image, kind="svg", border=2, dark="#000", light="#fff", scale=6)
        return Response(image.getvalue(), media_type="image/svg+xml")

    @app.api_route(ASSET_PREFIX + "settings.json", methods=["GET", "HEAD"], include_in_schema=False)
    def page_settings() -> dict[str, Any]:
        return _page_settings(settings, lan_url)

    for folder, package in VENDORED_PACKAGES.items():
        assets = _Assets(packages=[package])
        app.mount(ASSET_PREFIX + folder, GZipMiddleware(assets))
    app.mount(ASSET_PREFIX, GZipMiddleware(_Assets(directory=PAGE_FOLDER)))


def _page_settings(settings: Settings, lan_url: str | None) -> dict[str, Any]:
    """Settings of the page. Served without a key: must not expose stored data."""
    return {
        "map_tiles": settings.map_tiles,
        "map_tiles_are_chosen": "map_tiles" in settings.model_fields_set,
        "map_attribution": settings.tile_attribution,
        "max_file_size": settings.max_file_size,
        "lan_url": lan_url,
        "job_kinds": STATUS_PAGE_JOBS,
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
        "Cache-Control": CACHE_CONTROL,
    }
