"""The web page: static files without a build step, served by `services/gateway/web_page.py`.

`page/` contains plain ES modules and one style sheet. The only library is Leaflet, which comes from
an installed package.
"""

from __future__ import annotations

from pathlib import Path

PAGE_FOLDER = Path(__file__).parent / "page"
"""Contains index.html, docs.html, redoc.html, and the assets that they load from `/console/`."""
