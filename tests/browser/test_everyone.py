"""The page for everyone: by keyboard, with a screen reader, on a narrow phone, in the dark."""

from __future__ import annotations

from typing import Any

import pytest
from axe_core_python.sync_playwright import Axe
from playwright.sync_api import Page, expect

from tests.browser.conftest import CityServer, Visitor

VIEWS = ["ask", "answer", "compare", "photos", "photo", "tracks", "track"]
VIEWS += ["add", "locate", "places", "trash", "model", "reconstruction", "status"]
SERIOUS = {"serious", "critical"}


def open_view(visitor: Visitor, city: CityServer, view: str) -> Page:
    if view == "photo":
        stored = city.get("/search", role="database", limit=1)["images"][0]
        page = visitor.visit(f"photo/{stored['image_id']}")
        expect(page.locator("path.point")).to_be_attached()
    elif view == "track":
        page = visitor.visit(f"tracks/{city.ride()}")
        expect(page.locator("path.point.tracking").first).to_be_attached()
    elif view in ("answer", "compare"):
        page = visitor.visit("ask")
        page.locator("input[data-use=ask]").set_input_files(city.queries[0])
        expect(page.locator(".number-pin").first).to_be_visible()
        if view == "compare":
            page.locator(".match").first.click()
            expect(page.locator(".points")).to_be_visible()
    else:
        page = visitor.visit(view)
        if view == "photos":
            expect(page.locator(".photo-card").first).to_be_visible()
            page.get_by_text("More filters").click()
    return page


def serious_faults(page: Page) -> list[str]:
    """The serious accessibility faults of the page as it is shown."""
    return [
        f"{fault['id']}: {node['html'][:200]} {node['failureSummary']}"
        for fault in Axe().run(page)["violations"]
        if fault["impact"] in SERIOUS
        for node in fault["nodes"]
    ]


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("view", VIEWS)
def test_no_view_has_a_serious_accessibility_fault(
    visitor: Visitor, city: CityServer, view: str, scheme: Any
) -> None:
    visitor.page.emulate_media(color_scheme=scheme)
    assert serious_faults(open_view(visitor, city, view)) == []


@pytest.mark.parametrize("view", VIEWS)
def test_no_view_is_wider_than_a_narrow_phone(
    visitor: Visitor, city: CityServer, view: str
) -> None:
    visitor.page.set_viewport_size({"width": 320, "height": 640})
    page = open_view(visitor, city, view)
    assert page.evaluate("document.documentElement.scrollWidth") <= 320


def focused(page: Page) -> str:
    name: str = page.evaluate(
        "document.activeElement.getAttribute('aria-label') || document.activeElement.textContent"
    )
    return name.strip()


def test_a_match_is_reached_by_keyboard_alone(visitor: Visitor, city: CityServer) -> None:
    stored = city.get("/search", role="database", limit=1)["images"][0]
    page = visitor.visit(f"ask/{stored['image_id']}")
    expect(page.locator(".match")).to_have_count(12)
    page.locator(".skip").press("Enter")
    for _ in range(40):
        page.keyboard.press("Tab")
        if focused(page).startswith("Match 1"):
            break
    outline = page.evaluate("getComputedStyle(document.activeElement).outlineStyle")
    assert outline == "solid", "who uses the keyboard sees where they are"
    page.keyboard.press("Enter")
    expect(page.get_by_role("dialog")).to_be_visible()
    page.keyboard.press("Escape")
    expect(page.get_by_role("dialog")).to_have_count(0)
    assert focused(page).startswith("Match 1")


def test_views_are_named_and_marked_as_the_current_one(visitor: Visitor) -> None:
    page = visitor.visit("ask")
    page.get_by_role("link", name="Advanced").press("Enter")
    expect(page.get_by_role("heading", name="Model", exact=True)).to_be_visible()
    expect(page).to_have_title("Model · riverside · Placewise")
    expect(page.locator(".tabs [aria-current=page]")).to_have_text("Advanced")
    page.get_by_role("link", name="Tracks").press("Enter")
    expect(page.get_by_role("heading", name="Tracks", exact=True)).to_be_visible()
    expect(page.locator(".tabs [aria-current=page]")).to_have_text("Advanced")


def test_an_unreachable_server_is_reported_and_found_again(visitor: Visitor) -> None:
    page = visitor.visit("status")
    expect(page.locator(".card .chip.healthy")).to_be_visible()
    page.route("**/api/**", lambda route: route.abort())
    page.route("**/console/views/**", lambda route: route.abort())
    expect(page.get_by_text("be reached. Is it running?")).to_be_visible()
    expect(page.locator(".card .chip.healthy")).to_have_count(0)
    page.get_by_role("link", name="Photos").click()
    expect(page.get_by_role("button", name="Try again")).to_be_visible()
    page.unroute_all()
    page.get_by_role("button", name="Try again").click()
    expect(page.locator(".photo-card").first).to_be_visible()
    page.goto(f"{visitor.url}/#/tracks/no-track")
    expect(page.get_by_role("link", name="All tracks")).to_be_visible()
