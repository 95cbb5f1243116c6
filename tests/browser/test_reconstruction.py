"""The reconstruction of a map on the page: made, shown with what it left out, and its proposals."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import BrowserContext, Page, expect

from tests.browser.conftest import Visitor
from tests.browser.test_everyone import serious_faults
from tests.support.photos import photo_bytes
from tests.support.reconstructable_server import (
    SCENE,
    STRAY,
    WRONG,
    WRONG_DEGREES,
    reconstructable_server,
)
from tests.support.server import ServerProcess


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServerProcess]:
    with reconstructable_server(tmp_path_factory.mktemp("walk")) as server:
        yield server


@pytest.fixture
def page(context: BrowserContext, walk: ServerProcess) -> Iterator[Page]:
    """The view, of a map that is reconstructed by its button if it is not yet."""
    visitor = Visitor(context, str(walk.client.base_url).rstrip("/"))
    page = visitor.visit("reconstruction")
    first = page.get_by_role("button", name="Reconstruct the photos")
    expect(first.or_(page.locator("tbody"))).to_be_visible()
    if first.count():
        first.click()
        expect(page.get_by_role("progressbar", name="Reconstructing the photos")).to_be_visible()
    expect(page.locator("tbody tr")).to_have_count(1)
    yield page
    assert visitor.faults == visitor.foreign == []


def latitude(walk: ServerProcess) -> Any:
    found = walk.client.get("/api/v1/search", params={"filename": f"{WRONG}.jpg"})
    return found.json()["images"][0]["latitude"]


def test_components_and_photos_left_out_are_shown_with_the_reasons(page: Page) -> None:
    expect(page.locator(".facts")).to_contain_text(f"{SCENE.photos} of {SCENE.photos + 1}")
    agreeing = f"from the coordinates of {SCENE.photos - 1} of {SCENE.photos} photos"
    expect(page.locator("tbody")).to_contain_text(agreeing)
    left_out = page.locator("details", has_text="1 photo left out")
    expect(left_out).to_contain_text("No other photo shows the same")
    expect(left_out.get_by_role("link", name=STRAY)).to_be_visible()
    with page.expect_download() as download:
        page.get_by_role("button", name="Download as COLMAP models").click()
    assert download.value.suggested_filename.endswith(".tar")


def test_a_proposal_is_accepted_and_undone_with_before_and_after_on_the_map(
    page: Page, walk: ServerProcess
) -> None:
    before = latitude(walk)
    card = page.locator(".proposal")
    expect(card).to_have_count(1)
    expect(card).to_contain_text("111 m away")
    expect(page.locator("path.path, path.point.lost")).to_have_count(2)
    page.get_by_role("button", name="Show the map as it was before").click()
    expect(page.locator("path.path")).to_have_count(0)
    expect(page.locator(".number-pin")).to_have_count(1)
    card.get_by_role("button", name="Accept").click()
    expect(page.locator(".given li")).to_have_count(1)
    expect(card).to_have_count(0)
    assert before - latitude(walk) == pytest.approx(WRONG_DEGREES, abs=1e-5)
    page.locator(".given").get_by_role("button", name="Undo").click()
    expect(card).to_have_count(1)
    assert latitude(walk) == before
    card.get_by_role("button", name="Not this").click()
    expect(card).to_have_count(0)
    assert latitude(walk) == before


@pytest.mark.parametrize("width", [1280, 390, 320])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_reconstruction_is_for_everyone(
    page: Page, scheme: Any, width: int, pictures: Path
) -> None:
    page.emulate_media(color_scheme=scheme)
    page.set_viewport_size({"width": width, "height": 860})
    page.locator(".proposal img").scroll_into_view_if_needed()
    expect(page.locator(".proposal img")).to_have_attribute("src", re.compile("^blob:"))
    assert serious_faults(page) == []
    page.screenshot(path=pictures / f"reconstruction-{scheme}-{width}.png", full_page=True)
    assert page.evaluate("document.documentElement.scrollWidth") <= width


def test_photos_without_local_features_get_them_first_and_a_failed_run_says_why(
    page: Page, walk: ServerProcess
) -> None:
    made = walk.client.post("/api/v1/maps", json={"name": "plain", "matching": "off"})
    assert made.is_success, made.text
    for number in range(3):
        walk.indexed(photo_bytes(number), map_name="plain")
    page.reload()
    page.locator("#map-choice").select_option("plain")
    start = page.get_by_role("button", name="Reconstruct the photos")
    start.click()
    page.get_by_role("button", name="Compute them").click()
    expect(page.get_by_text("Computing local features: done.")).to_be_visible()
    start.click()
    expect(page.locator(".standing .bad")).to_contain_text("The last run failed:")
