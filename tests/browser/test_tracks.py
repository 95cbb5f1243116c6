"""Tracks on the page: the list, one track over the map, and its deletion."""

from __future__ import annotations

from playwright.sync_api import expect

from tests.browser.conftest import CityServer, Visitor


def test_a_track_is_listed_drawn_and_deleted(visitor: Visitor, city: CityServer) -> None:
    track_id = city.ride()
    page = visitor.visit("tracks")
    with page.expect_response(lambda response: "smoothed=true" in response.url):
        page.locator(f"a[href='#/tracks/{track_id}']").click()
    expect(page.get_by_text("3 frames, ")).to_be_visible()
    expect(page.locator("tbody tr")).to_have_count(3)
    expect(page.locator("path.point:not(.behind)")).to_have_count(3)
    expect(page.locator("path.point.behind").first).to_be_attached()
    expect(page.locator("path.uncertainty").first).to_be_attached()
    with page.expect_response(lambda response: "smoothed=false" in response.url):
        page.get_by_label("Use later frames, too").uncheck()
    expect(page.locator("path.point:not(.behind)")).to_have_count(3)
    page.get_by_role("button", name="Delete…").click()
    page.get_by_role("button", name="Delete", exact=True).click()
    expect(page.get_by_role("heading", name="Tracks", exact=True)).to_be_visible()
    expect(page.locator(f"a[href='#/tracks/{track_id}']")).to_have_count(0)
    assert track_id not in {track["track_id"] for track in city.get("/tracks")["tracks"]}
    visitor.expect_no_error()
