"""Photos in: one by one, in batches, and refused ones named."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import FilePayload, Page, expect

from tests.browser.conftest import CityServer, Visitor
from tests.support.archives import tar_of, zip_of
from tests.support.photos import encoded, photo_bytes, photo_image

NO_PHOTO: FilePayload = {
    "name": "notes.jpg",
    "mimeType": "image/jpeg",
    "buffer": b"not a photo at all" * 9,
}


def photo(number: int) -> FilePayload:
    return {"name": f"{number}.jpg", "mimeType": "image/jpeg", "buffer": photo_bytes(number)}


@pytest.fixture
def page(visitor: Visitor, city: CityServer, request: pytest.FixtureRequest) -> Iterator[Page]:
    """The view on a map of the test's own, with an extractor that takes no time."""
    name = f"add-{abs(hash(request.node.name)) % 10**9}"
    made = {"name": name, "extractor": "test-tiny-avg"}
    assert city.server.client.post("/api/v1/maps", json=made).status_code == 201
    visitor.page.goto(city.url)
    visitor.page.evaluate("name => localStorage.setItem('placewise-map', name)", name)
    yield visitor.visit("add")
    city.server.client.delete(f"/api/v1/maps/{name}")


def add(page: Page, *files: FilePayload) -> None:
    page.locator("input[data-use=add]").set_input_files(list(files))


def searchable(page: Page, city: CityServer) -> int:
    name = page.evaluate("localStorage.getItem('placewise-map')")
    answer = city.server.client.get(f"/api/v1/maps/{name}").json()
    return int(answer["searchable"])


def test_each_photo_but_hidden_ones_is_watched_until_it_can_be_found(
    page: Page, city: CityServer
) -> None:
    add(page, {**photo(1), "name": "._1.jpg"}, photo(1), photo(2))
    expect(page.locator(".queue-row.done .state")).to_have_text(["Searchable", "Searchable"])
    expect(page.locator(".queue-row")).to_have_count(2)
    expect(page.locator(".summary h2")).to_have_text("2 photos added")
    assert searchable(page, city) == 2
    add(page, photo(2))
    expect(page.locator(".queue-row.done")).to_have_count(3)
    expect(page.get_by_text("the map had it already")).to_be_visible()


def test_a_refused_file_is_named_with_the_reason_and_the_others_go_on(
    page: Page, city: CityServer
) -> None:
    add(page, NO_PHOTO, photo(1))
    refused = page.locator(".queue-row.failed")
    expect(refused.locator(".queue-name")).to_have_text("notes.jpg")
    expect(refused.locator(".errors")).to_contain_text("JPEG")
    expect(page.locator(".queue-row.done")).to_have_count(1)
    expect(page.locator(".summary .bad")).to_have_text("1 failed")
    expect(page.locator(".queue-row.done, .queue-row.failed")).to_have_count(2)
    expect(page.locator(".queue-row").first.locator(".queue-name")).to_have_text("notes.jpg")
    # The same bytes would be refused again.
    expect(page.get_by_role("button", name="Try")).to_have_count(0)


def test_many_photos_go_as_a_batch_with_counters_and_named_errors(
    page: Page, city: CityServer
) -> None:
    page.get_by_text("Details for these photos").click()
    page.get_by_label("Tags").fill("north, wing")
    add(page, *[photo(number) for number in range(30)], NO_PHOTO)
    expect(page.locator(".queue-row.failed .state")).to_have_text("30 photos added, 1 failed")
    expect(page.locator(".errors li strong")).to_have_text("notes.jpg")
    assert searchable(page, city) == 30
    name = page.evaluate("localStorage.getItem('placewise-map')")
    found = city.get("/search", map=name, tags="north,wing")
    assert found["total_found"] == 30


def test_test_photos_are_used_by_evaluations_and_are_no_search_results(
    page: Page, city: CityServer
) -> None:
    page.get_by_text("Details for these photos").click()
    page.get_by_label("Use").select_option("Test photos")
    add(page, photo(1))
    expect(page.locator(".queue-row.done")).to_have_count(1)
    name = page.evaluate("localStorage.getItem('placewise-map')")
    [stored] = city.get("/search", map=name)["images"]
    assert stored["role"] == "query"
    page.get_by_role("link", name="See the photos").click()
    expect(page.locator(".photo-card .corner")).to_have_text("test photo")
    page.locator(".photo-card a").click()
    expect(page.locator(".facts")).to_contain_text("no: a test photo")


def test_a_photo_that_can_not_be_described_is_marked_with_the_reason(
    page: Page, visitor: Visitor
) -> None:
    whole = encoded(photo_image(4, 640, 480), "JPEG")
    damaged = whole[: len(whole) // 2]
    add(page, {"name": "damaged.jpg", "mimeType": "image/jpeg", "buffer": damaged}, photo(1))
    expect(page.locator(".queue-row.done, .queue-row.failed")).to_have_count(2)
    page.get_by_role("link", name="See the photos").click()
    marked = page.locator(".photo-card", has=page.get_by_text("not searchable"))
    expect(marked.locator(".photo-name")).to_have_text("damaged.jpg")
    marked.locator("a").click()
    expect(page.locator(".facts .bad")).to_contain_text("can't be decoded")
    visitor.visit("ask")
    expect(page.locator(".mosaic a")).to_have_count(1)
    visitor.visit("status")
    expect(page.get_by_role("row", name="Photo failed")).to_contain_text("can't be decoded")


def test_a_photo_of_a_folder_is_named_with_its_path(
    page: Page, city: CityServer, tmp_path: Path
) -> None:
    folder = tmp_path / "Italy" / "Day 2"
    folder.mkdir(parents=True)
    (folder / "IMG_2078.jpg").write_bytes(photo_bytes(3))
    page.locator("input[webkitdirectory]").set_input_files(tmp_path / "Italy")
    expect(page.locator(".queue-row.done .queue-name")).to_have_text("Italy/Day 2/IMG_2078.jpg")
    page.get_by_role("link", name="See the photos").click()
    expect(page.locator(".photo-name")).to_have_text("Italy/Day 2/IMG_2078.jpg")
    page.locator(".photo-card a").click()
    expect(page.locator("h1")).to_have_text("Italy/Day 2/IMG_2078.jpg")


def archive(name: str, data: bytes) -> FilePayload:
    return {"name": name, "mimeType": "application/octet-stream", "buffer": data}


@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_the_photos_of_a_zip_keep_their_paths_and_get_the_details(
    page: Page, city: CityServer, method: int
) -> None:
    page.get_by_text("Details for these photos").click()
    page.get_by_label("Tags").fill("north")
    photos = {f"hall/{number} ü.jpg": photo_bytes(number) for number in range(3)}
    others = {"hall/notes.txt": b"", "__MACOSX/._0.jpg": b"", "hall/photos.csv": b"filename\n"}
    add(page, archive("h.zip", zip_of({**photos, **others, "empty/": b""}, method)))
    expect(page.locator(".queue-row.done .state")).to_have_text("3 photos added")
    expect(page.get_by_text("1 file left out: no photos.")).to_be_visible()
    expect(page.get_by_text("hall/photos.csv of h.zip is not read here")).to_be_visible()
    assert searchable(page, city) == 3
    name = page.evaluate("localStorage.getItem('placewise-map')")
    images = city.get("/search", map=name, tags="north")["images"]
    assert {image["relative_path"] for image in images} == set(photos)


def test_an_archive_that_the_page_can_not_read_says_what_to_do(page: Page) -> None:
    whole = zip_of({"1.jpg": photo_bytes(1)})
    for name, data, words in (
        ("cut.zip", whole[:-30], "cut.zip is damaged. Unpack it and add the folder."),
        ("no.zip", b"no zip" * 99, "no.zip is damaged. Unpack it and add the folder."),
        ("empty.zip", zip_of({"notes.txt": b""}), "empty.zip has no photos."),
        ("a.tar.gz", tar_of({"1.jpg": b""}, "w:gz"), "unpack it, or run placewise index."),
    ):
        add(page, archive(name, data))
        expect(page.get_by_text(words)).to_be_visible()
    expect(page.locator(".queue-row")).to_have_count(0)
    flags = whole.index(b"PK\x01\x02") + 8
    add(page, archive("locked.zip", whole[:flags] + b"\x01" + whole[flags + 1 :]))
    expect(page.locator(".queue-row.failed .errors")).to_contain_text("can't be read, 1.jpg")


def test_a_lost_connection_is_shown_and_the_photo_sent_again(page: Page, city: CityServer) -> None:
    page.route("**/api/v1/upload?*", lambda route: route.abort())
    add(page, photo(1))
    expect(page.locator(".queue-row.failed .errors")).to_contain_text("connection")
    page.unroute("**/api/v1/upload?*")
    page.get_by_role("button", name="Try again").click()
    expect(page.locator(".queue-row.done .state")).to_have_text("Searchable")


def test_photos_that_the_map_has_are_not_counted_as_added(page: Page, city: CityServer) -> None:
    add(page, photo(1), photo(2))
    expect(page.locator(".summary h2")).to_have_text("2 photos added")
    page.get_by_role("button", name="Clear the list").click()
    add(page, photo(2), photo(3))
    expect(page.locator(".summary h2")).to_have_text("1 photo added, 1 already there")
    page.get_by_role("button", name="Clear the list").click()
    add(page, *[photo(number) for number in range(30)])
    expect(page.locator(".queue-row.done .state")).to_have_text("27 photos added, 3 already there")
