"""The screenshots that the README and the page's own page show: generated places only."""

from __future__ import annotations

from pathlib import Path

from playwright.sync_api import FilePayload, Page, expect

from tests.browser.conftest import MAP, CityServer, Visitor

MOST_BYTES = 300_000
LOADED = """() => [...document.images].filter((image) =>
    image.checkVisibility() && image.getBoundingClientRect().top < innerHeight
    && image.src.startsWith("data:image/gif")
).length"""


def take(page: Page, path: Path) -> None:
    """A picture of what is in sight, once all photos there are loaded."""
    page.wait_for_load_state("networkidle")
    while page.evaluate(LOADED):
        page.wait_for_timeout(100)
    page.wait_for_timeout(300)
    page.screenshot(path=path, type="jpeg", quality=82)
    assert path.stat().st_size < MOST_BYTES


def learn(city: CityServer) -> None:
    """A vocabulary of the map's own, measured."""
    if city.get(f"/maps/{MAP}")["vocabulary"] != "own":
        city.work("/vocabularies")
    city.work("/evaluations")


def best_known(city: CityServer) -> Path:
    """A query that the map knows, and of these the one with the most similar match."""

    def likeness(photo: Path) -> tuple[bool, float]:
        found = city.ask(photo)
        return bool(found["estimate"]["in_map"]), found["similar_images"][0]["similarity_score"]

    return max(city.queries, key=likeness)


def test_pictures_are_taken(visitor: Visitor, city: CityServer, pictures: Path) -> None:
    learn(city)
    query = best_known(city)
    data: FilePayload = {
        "name": "a-walk.jpg",
        "mimeType": "image/jpeg",
        "buffer": query.read_bytes(),
    }
    for name, size, scheme in (
        ("ask", (1280, 860), "light"),
        ("ask-dark", (1280, 860), "dark"),
        ("ask-phone", (390, 844), "light"),
    ):
        visitor.page.set_viewport_size({"width": size[0], "height": size[1]})
        visitor.page.emulate_media(color_scheme=scheme)  # type: ignore[arg-type]
        page = visitor.visit("ask")
        page.locator("input[data-use=ask]").set_input_files(data)
        expect(page.locator(".number-pin").first).to_be_attached()
        page.evaluate("window.scrollTo(0, 0)")
        take(page, pictures / f"{name}.jpg")
    visitor.page.set_viewport_size({"width": 1280, "height": 860})
    visitor.page.emulate_media(color_scheme="light")
    page.locator(".match").first.click()
    expect(page.locator(".points")).to_be_visible()
    take(page, pictures / "compare.jpg")
    page.keyboard.press("Escape")
    page = visitor.visit("photos")
    page.get_by_text("More filters").click()
    page.get_by_label("Use").select_option("database")
    page.get_by_text("More filters").click()
    page.get_by_role("button", name="Show the map").click()
    expect(page.locator("path.point").first).to_be_attached()
    visitor.expect_no_error()
    take(page, pictures / "photos.jpg")
    visitor.visit("model")
    take(page, pictures / "model.jpg")
