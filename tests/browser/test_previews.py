"""Photos at the size of a screen: what the browser loads of them."""

from __future__ import annotations

import pillow_heif
import pytest
from playwright.sync_api import expect

from tests.browser.city import finished
from tests.browser.conftest import MAP, CityServer, Visitor
from tests.support.photos import encoded, photo_image


def bring_in(city: CityServer, name: str, data: bytes) -> str:
    """A photo of the map `riverside` that no search returns; its id."""
    answer = city.server.client.post(
        "/api/v1/upload",
        params={"map": MAP},
        files={"file": (name, data)},
        data={"role": "query"},
    )
    assert answer.status_code == 202, answer.text
    finished(city.server, MAP, answer.json()["job_id"])
    return str(answer.json()["file_id"])


def show(visitor: Visitor, photo_id: str, width: int) -> list[str]:
    """Open the photo's page, until its image has this width; the images that it loads."""
    loaded: list[str] = []
    visitor.page.on("request", lambda request: loaded.append(request.url))
    page = visitor.visit(f"photo/{photo_id}")
    expect(page.locator(".large-photo img")).to_have_js_property("naturalWidth", width)
    expect(page.locator(".large-photo img:not(.missing)")).to_be_visible()
    paths = [url.partition("?")[0] for url in loaded if f"/uploads/{photo_id}/" in url]
    return [path.rpartition("/")[2] for path in paths]


@pytest.mark.parametrize("media", ["JPEG", "HEIF", "TIFF"])
def test_a_photo_of_a_camera_is_shown_as_a_preview(
    visitor: Visitor, city: CityServer, media: str
) -> None:
    pillow_heif.register_heif_opener()
    photo = photo_image(900 + sum(map(ord, media)), 2400, 1600)
    photo_id = bring_in(city, f"camera.{media.lower()}", encoded(photo, media))
    assert show(visitor, photo_id, 1600) == ["preview"]


def test_a_small_photo_is_shown_as_it_is(visitor: Visitor, city: CityServer) -> None:
    photo_id = bring_in(city, "small.png", encoded(photo_image(950, 320, 240), "PNG"))
    assert show(visitor, photo_id, 320) == ["preview"]


def test_a_photo_without_a_preview_is_shown_once_it_is_made(
    visitor: Visitor, city: CityServer
) -> None:
    photo_id = bring_in(city, "old.tiff", encoded(photo_image(960, 2000, 1000), "TIFF"))
    [preview] = city.server.home.rglob(f"previews/{photo_id}.jpg")
    preview.unlink()
    # The browser can't show the original, and waits for the preview.
    assert show(visitor, photo_id, 1600) == ["preview", "image", "preview"]
    assert preview.is_file()


@pytest.mark.parametrize(("media", "ending"), [("HEIF", "heic"), ("TIFF", "tif")])
def test_a_query_photo_that_the_browser_can_not_show_is_shown_as_a_preview(
    visitor: Visitor, city: CityServer, media: str, ending: str
) -> None:
    pillow_heif.register_heif_opener()
    photo = encoded(photo_image(970, 2400, 1600), media)
    page = visitor.visit("ask")
    page.locator("input[data-use=ask]").set_input_files(
        {"name": f"query.{ending}", "mimeType": "", "buffer": photo}
    )
    expect(page.locator(".verdict")).to_be_visible()
    expect(page.locator(".query-photo img")).to_have_js_property("naturalWidth", 1600)
    page.locator(".match").first.click()
    expect(page.locator(".compare figure img").first).to_have_js_property("naturalWidth", 1600)
    visitor.expect_no_error()
