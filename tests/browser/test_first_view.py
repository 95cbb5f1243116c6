"""What the page costs, and whom it asks."""

from __future__ import annotations

from typing import Any

import pytest
from playwright.sync_api import BrowserContext, expect

from tests.browser.conftest import CityServer, Visitor

MOST_BYTES = 300_000


def test_the_first_view_loads_few_bytes(context: BrowserContext, visitor: Visitor) -> None:
    received: list[float] = []
    network = context.new_cdp_session(visitor.page)
    network.send("Network.enable")
    network.on("Network.loadingFinished", lambda end: received.append(end["encodedDataLength"]))
    page = visitor.visit("ask")
    expect(page.locator(".mosaic img").first).to_be_visible()
    page.wait_for_load_state("networkidle")
    assert len(received) > 10
    assert sum(received) < MOST_BYTES, f"{sum(received):.0f} bytes"


@pytest.mark.parametrize("path", ["/docs", "/redoc"])
def test_the_api_is_described_without_any_other_server(
    context: BrowserContext, city: CityServer, path: str
) -> None:
    answered: list[Any] = []
    context.on("requestfinished", lambda request: answered.append(request.url))
    page = context.new_page()
    page.goto(city.url + path)
    expect(page.get_by_text("/api/v1/similarity/{file_id}").first).to_be_visible()
    # ReDoc would show its maker's mark; the page's policy keeps that request from leaving.
    elsewhere = [url for url in answered if not url.startswith((city.url, "blob:", "data:"))]
    assert elsewhere == []
