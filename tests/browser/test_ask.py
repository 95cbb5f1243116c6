"""A photo out of the browser: the page says what the API answers."""

from __future__ import annotations

from pathlib import Path

import pytest
from playwright.sync_api import Page, Route, expect

from tests.browser.conftest import Town, Visitor

TITLES = {True: "In this map", False: "Not in this map", None: "Best guess"}


def ask(visitor: Visitor, photo: Path) -> Page:
    page = visitor.visit("ask")
    page.locator("input[data-use=ask]").set_input_files(photo)
    expect(page.locator(".verdict")).to_be_visible()
    return page


@pytest.mark.parametrize("number", range(4))
def test_the_page_says_where_a_photo_was_taken_or_that_it_is_not_in_the_map(
    visitor: Visitor, town: Town, number: int
) -> None:
    photo = town.queries[number]
    found = town.ask(photo)
    page = ask(visitor, photo)
    estimate = found["estimate"]
    expect(page.locator(".badge")).to_have_text(TITLES[estimate["in_map"]])
    expect(page.locator(".match")).to_have_count(len(found["similar_images"]))
    first = page.locator(".match").first
    expect(first.locator(".figure")).to_have_text(
        f"{found['similar_images'][0]['similarity_score']:.3f}"
    )
    expect(page.locator(".number-pin")).to_have_count(len(found["similar_images"]))
    circles = 0 if estimate["latitude"] is None else 1
    expect(page.locator("path.estimate")).to_have_count(circles)
    if circles:
        expect(page.locator(".verdict .where")).to_contain_text(f"{estimate['latitude']:.5f}")
        expect(page.locator(".verdict .radius")).to_contain_text(f"{estimate['radius_m']:.0f} m")


def test_a_pasted_photo_is_asked_with(visitor: Visitor, town: Town) -> None:
    page = visitor.visit("ask")
    expect(page.locator(".mosaic")).to_be_visible()
    page.evaluate(
        """bytes => {
            const data = new DataTransfer();
            data.items.add(new File([new Uint8Array(bytes)], "pasted.jpg", { type: "image/jpeg" }));
            document.dispatchEvent(new ClipboardEvent("paste", { clipboardData: data }));
        }""",
        list(town.queries[0].read_bytes()),
    )
    expect(page.locator(".verdict")).to_be_visible()
    expect(page.locator(".query-photo figcaption")).to_have_text("pasted.jpg")


def test_of_two_questions_the_later_one_is_answered(visitor: Visitor, town: Town) -> None:
    page = visitor.visit("ask")
    held: list[Route] = []
    page.route("**/api/v1/similarity?*", lambda route: held.append(route), times=1)
    page.locator("input[data-use=ask]").set_input_files(town.queries[0])
    expect(page.get_by_role("heading", name="Looking for the place")).to_be_visible()
    page.locator("input[data-use=ask]").set_input_files(
        {"name": "later.jpg", "mimeType": "image/jpeg", "buffer": town.queries[1].read_bytes()}
    )
    expect(page.locator(".query-photo figcaption")).to_have_text("later.jpg")
    with page.expect_response("**/api/v1/similarity?*"):
        held[0].continue_()
    page.wait_for_load_state("networkidle")
    expect(page.locator(".query-photo figcaption")).to_have_text("later.jpg")


def test_what_is_no_photo_gets_the_reason(visitor: Visitor) -> None:
    page = visitor.visit("ask")
    page.locator("input[data-use=ask]").set_input_files(
        {"name": "notes.txt", "mimeType": "text/plain", "buffer": b"no photo" * 20}
    )
    expect(page.get_by_role("heading", name="No answer")).to_be_visible()
    expect(page.locator(".refused")).to_contain_text("JPEG")


def test_a_match_is_shown_beside_the_photo_with_what_speaks_for_it(
    visitor: Visitor, town: Town
) -> None:
    page = ask(visitor, town.queries[0])
    page.locator(".match").first.click()
    dialog = page.get_by_role("dialog")
    expect(dialog.locator(".frame")).to_have_count(2)
    overlay = dialog.locator(".overlay")
    expect(overlay).to_be_visible()
    assert (overlay.get_attribute("src") or "").startswith("data:image/png;base64,")
    page.keyboard.press("ArrowRight")
    expect(dialog.get_by_role("heading")).to_have_text("Match 2 of 12")
    expect(overlay).to_be_visible()
    page.keyboard.press("Escape")
    expect(dialog).to_have_count(0)


def test_a_photo_of_the_map_finds_its_neighbours_and_not_itself(
    visitor: Visitor, town: Town
) -> None:
    stored = town.get("/search", role="database", limit=1)["images"][0]
    page = visitor.visit(f"ask/{stored['image_id']}")
    expect(page.locator(".match")).to_have_count(12)
    assert stored["original_filename"] not in page.locator(".matches").inner_text()


def test_an_empty_map_says_what_to_do_next(visitor: Visitor) -> None:
    page = visitor.page
    page.goto(visitor.url)
    page.evaluate("localStorage.setItem('placewise-map', 'default')")
    visitor.visit("ask")
    page.get_by_role("link", name="Add some first").click()
    expect(page.get_by_role("heading", name="Add photos")).to_be_visible()
