"""The web page: static files without a build step, served by `services/gateway/web_page.py`.

`html/` contains the pages, `page/` plain ES modules and one style sheet. The only library is
Leaflet, which comes from an installed package.
"""

from __future__ import annotations

from pathlib import Path

HTML_FOLDER = Path(__file__).parent / "html"
"""index.html, docs.html and redoc.html"""
PAGE_FOLDER = Path(__file__).parent / "page"
"""The assets that they load from `/console/`"""
