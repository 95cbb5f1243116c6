"""The page: static files, without a build step. `services/gateway/web_page.py` serves them.

`page/` is what the browser gets: plain ES modules, one style sheet, and no library but Leaflet,
which a package brings.
"""

from __future__ import annotations

from pathlib import Path

PAGE_FOLDER = Path(__file__).parent / "page"
"""index.html, docs.html, redoc.html, and below them what those load from `/console/`."""
