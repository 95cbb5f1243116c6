"""Streets behind the maps: from another server, and only for those who agree."""

from __future__ import annotations

import io

import pytest
from PIL import Image
from playwright.sync_api import BrowserContext, Page, Route, expect

from shared.config.gateway_settings import OPENSTREETMAP_ATTRIBUTION
from tests.browser.conftest import CityServer, Visitor

TILES = "https://tile.openstreetmap.org/"


def tile(route: Route) -> None:
    picture = io.BytesIO()
    Image.new("RGB", (256, 256), (200, 210, 220)).save(picture, "PNG")
    route.fulfill(body=picture.getvalue(), content_type="image/png")


@pytest.fixture
def visiting(context: BrowserContext, city: CityServer) -> Visitor:
    context.route(TILES + "**", tile)
    return Visitor(context, city.url)


def open_map(visiting: Visitor, city: CityServer) -> Page:
    stored = city.get("/search", role="database", limit=1)["images"][0]
    page = visiting.visit(f"photo/{stored['image_id']}")
    expect(page.locator("path.point")).to_be_attached()
    return page


def test_streets_are_loaded_once_the_visitor_agrees_and_until_they_are_hidden(
    visiting: Visitor, city: CityServer
) -> None:
    page = open_map(visiting, city)
    streets = page.get_by_role("button", name="Streets")
    streets.click()
    expect(page.get_by_role("dialog")).to_contain_text("tile.openstreetmap.org")
    page.get_by_role("button", name="Not now").click()
    page.wait_for_load_state("networkidle")
    expect(page.locator(".graticule-label").first).to_be_visible()
    assert visiting.foreign == []

    streets.click()
    page.get_by_role("button", name="Load streets").click()
    expect(page.locator(".leaflet-tile-loaded").first).to_be_visible()
    expect(page.locator(".leaflet-control-attribution")).to_contain_text(OPENSTREETMAP_ATTRIBUTION)
    expect(page.locator(".graticule-label")).to_have_count(0)
    assert visiting.foreign
    assert all(url.startswith(TILES) for url in visiting.foreign)

    page = open_map(visiting, city)
    expect(page.locator(".leaflet-tile-loaded").first).to_be_visible()
    page.get_by_role("button", name="Streets").click()
    expect(page.locator(".graticule-label").first).to_be_visible()
    loaded = len(visiting.foreign)
    page = open_map(visiting, city)
    page.wait_for_load_state("networkidle")
    expect(page.locator(".leaflet-tile")).to_have_count(0)
    assert len(visiting.foreign) == loaded
    assert visiting.faults == []


def test_the_graticule_stays_where_no_streets_can_be_loaded(
    context: BrowserContext, city: CityServer
) -> None:
    context.route(TILES + "**", lambda route: route.abort())
    page = open_map(Visitor(context, city.url), city)
    page.get_by_role("button", name="Streets").click()
    page.get_by_role("button", name="Load streets").click()
    expect(page.locator(".note.bad")).to_contain_text("be loaded from tile.openstreetmap.org")
    expect(page.locator(".graticule-label").first).to_be_visible()
    expect(page.get_by_role("button", name="Streets")).to_have_attribute("aria-pressed", "false")


@pytest.mark.parametrize("tiles", ["chosen", "off"])
def test_streets_of_a_chosen_server_are_shown_at_once_and_a_map_without_says_so(
    visiting: Visitor, city: CityServer, tiles: str
) -> None:
    settings = city.server.client.get("/console/settings.json").json()
    settings |= {"map_tiles_are_chosen": True} if tiles == "chosen" else {"map_tiles": None}
    visiting.page.route("**/console/settings.json", lambda route: route.fulfill(json=settings))
    page = open_map(visiting, city)
    if tiles == "off":
        expect(page.locator(".map-note")).to_contain_text("No streets")
        expect(page.get_by_role("button", name="Streets")).to_have_count(0)
        return
    expect(page.locator(".leaflet-tile-loaded").first).to_be_visible()
    page.get_by_role("button", name="Streets").click()
    expect(page.locator(".graticule-label").first).to_be_visible()
    page = open_map(visiting, city)  # hidden until the visitor wants them
    expect(page.locator(".graticule-label").first).to_be_visible()
    expect(page.locator(".leaflet-tile")).to_have_count(0)
    page.get_by_role("button", name="Streets").click()
    expect(page.locator(".leaflet-tile-loaded").first).to_be_visible()
    assert visiting.faults == []


def test_the_policy_lets_images_of_the_tile_server_through_and_nothing_else(
    visiting: Visitor, city: CityServer
) -> None:
    page = open_map(visiting, city)
    attempt = "(url) => fetch(url).then(() => 'loaded', () => 'refused')"
    assert page.evaluate(attempt, TILES + "0/0/0.png") == "refused"
    image = """(url) => new Promise((resolve) => {
        const image = new Image();
        image.onload = () => resolve('loaded');
        image.onerror = () => resolve('refused');
        image.src = url;
    })"""
    assert page.evaluate(image, TILES + "0/0/0.png") == "loaded"
    assert page.evaluate(image, "https://example.org/0/0/0.png") == "refused"


def test_coordinates_are_copied_and_opened_in_openstreetmap(
    visitor: Visitor, city: CityServer, context: BrowserContext
) -> None:
    context.grant_permissions(["clipboard-read", "clipboard-write"])
    stored = city.get("/search", role="database", limit=1)["images"][0]
    page = open_map(visitor, city)
    page.get_by_role("button", name="Copy").click()
    expected = f"{stored['latitude']:.5f}, {stored['longitude']:.5f}"
    expect(page.locator(".note")).to_contain_text(expected)
    assert page.evaluate("navigator.clipboard.readText()") == expected
    link = page.get_by_role("link", name="OpenStreetMap")
    at = f"mlat={stored['latitude']:.6f}&mlon={stored['longitude']:.6f}"
    assert at in (link.get_attribute("href") or "")
    assert link.get_attribute("rel") == "noopener noreferrer"
