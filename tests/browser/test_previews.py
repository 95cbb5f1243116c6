"""Photos at the size of a screen: what the browser loads of them."""

from __future__ import annotations

import re

import pillow_heif
import pytest
from playwright.sync_api import Page, expect

from tests.browser.conftest import MAP, PATIENCE_MS, Town, Visitor
from tests.support.photos import encoded, photo_image

WIDTH = """(image) => image.decode().then(() => image.naturalWidth)"""


def bring_in(town: Town, name: str, data: bytes) -> str:
    """A photo of the map `riverside` that no search returns; its id."""
    answer = town.server.client.post(
        "/api/v1/upload",
        params={"map": MAP},
        files={"file": (name, data)},
        data={"role": "query"},
        headers={"Prefer": "wait=60"},
    )
    assert answer.status_code == 201, answer.text
    return str(answer.json()["file_id"])


def show(visitor: Visitor, photo_id: str) -> tuple[Page, list[str]]:
    """The photo's page, and the images that it has loaded from the server."""
    loaded: list[str] = []
    visitor.page.on("request", lambda request: loaded.append(request.url))
    page = visitor.visit(f"photo/{photo_id}")
    page.wait_for_function(
        "document.querySelector('.large-photo img')?.naturalWidth > 1", timeout=PATIENCE_MS
    )
    return page, [url for url in loaded if f"/uploads/{photo_id}/" in url]


@pytest.mark.parametrize("media", ["JPEG", "HEIF", "TIFF"])
def test_a_photo_of_a_camera_is_shown_as_a_preview(
    visitor: Visitor, town: Town, media: str
) -> None:
    pillow_heif.register_heif_opener()
    photo = photo_image(900 + sum(map(ord, media)), 2400, 1600)
    photo_id = bring_in(town, f"camera.{media.lower()}", encoded(photo, media))
    page, loaded = show(visitor, photo_id)
    assert page.locator(".large-photo img").evaluate(WIDTH) == 1600
    assert [url.partition("?")[0].rpartition("/")[2] for url in loaded] == ["preview"]


def test_a_small_photo_is_shown_as_it_is(visitor: Visitor, town: Town) -> None:
    photo_id = bring_in(town, "small.png", encoded(photo_image(950, 320, 240), "PNG"))
    page, _ = show(visitor, photo_id)
    assert page.locator(".large-photo img").evaluate(WIDTH) == 320


def test_a_photo_without_a_preview_is_shown_once_it_is_made(visitor: Visitor, town: Town) -> None:
    photo_id = bring_in(town, "old.tiff", encoded(photo_image(960, 2000, 1000), "TIFF"))
    [preview] = town.server.home.rglob(f"previews/{photo_id}.jpg")
    preview.unlink()
    page, _ = show(visitor, photo_id)
    expect(page.locator(".large-photo img:not(.missing)")).to_be_visible()
    assert page.locator(".large-photo img").evaluate(WIDTH) == 1600
    assert preview.is_file()


def test_a_query_photo_that_the_browser_can_not_show_gets_a_drawing(
    visitor: Visitor, town: Town
) -> None:
    page = visitor.visit("ask")
    tiff = encoded(photo_image(970, 320, 240), "TIFF")
    page.locator("input[data-use=ask]").set_input_files(
        {"name": "query.tiff", "mimeType": "image/tiff", "buffer": tiff}
    )
    expect(page.locator(".verdict")).to_be_visible()
    picture = page.locator(".query-photo img")
    expect(picture).to_have_attribute("src", "/console/unshown.svg")
    expect(picture).to_have_attribute("title", re.compile("can.t show photos of this format"))
