"""Places to give: what is proposed for photos without a place, and what people say of answers."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from PIL import Image
from playwright.sync_api import Page, expect

from tests.browser.conftest import MAP, CityServer, Visitor


@pytest.fixture
def unplaced(city: CityServer, tmp_path: Path) -> Iterator[list[str]]:
    """Darker copies of two photos of the map, without coordinates; their ids."""
    ids = []
    for number, stored in enumerate(city.get("/search", role="database", limit=2)["images"]):
        original = tmp_path / "original.jpg"
        original.write_bytes(city.server.client.get(stored["image_url"]).content)
        path = tmp_path / f"unplaced-{number}.jpg"
        with Image.open(original) as image:
            image.point(lambda value: int(value * 0.9)).save(path)
        ids.append(city.server.indexed(path.read_bytes(), path.name, MAP))
    yield ids
    for file_id in ids:
        params = {"map": MAP, "permanently": "true"}
        city.server.client.delete(f"/api/v1/uploads/{file_id}", params=params)


def position(city: CityServer, file_id: str) -> Any:
    photo = city.get(f"/uploads/{file_id}")
    return photo["latitude"], photo["longitude"]


def open_places(visitor: Visitor) -> Page:
    page = visitor.visit("photos")
    expect(page.get_by_text("2 photos have no place.")).to_be_visible()
    page.get_by_role("link", name="See proposals").click()
    expect(page.locator(".proposal")).to_have_count(2)
    expect(page.locator(".number-pin")).to_have_count(2)
    return page


def test_proposals_are_given_at_once_and_taken_back(
    visitor: Visitor, city: CityServer, unplaced: list[str]
) -> None:
    page = open_places(visitor)
    expect(page.locator(".lead")).to_contain_text("2 photos have no place")
    expect(page.locator(".proposal").first).to_contain_text("Looks like")
    assert [position(city, each) for each in unplaced] == [(None, None)] * 2
    page.get_by_label("Accept from (%)").fill("1")
    page.get_by_role("button", name="Give 2 places").click()
    expect(page.locator(".given li")).to_have_count(2)
    assert None not in [latitude for latitude, _ in (position(city, each) for each in unplaced)]
    page.locator(".note").get_by_role("button", name="Undo").click()
    expect(page.locator(".proposal")).to_have_count(2)
    expect(page.locator(".given li")).to_have_count(0)
    assert [position(city, each) for each in unplaced] == [(None, None)] * 2
    visitor.expect_no_error()


def test_one_proposal_is_given_and_the_others_are_left(
    visitor: Visitor, city: CityServer, unplaced: list[str]
) -> None:
    page = open_places(visitor)
    page.get_by_role("button", name="Show the map as it was before").click()
    expect(page.locator(".number-pin")).to_have_count(0)
    expect(page.locator("path.point.behind").first).to_be_attached()
    page.get_by_role("button", name="Give this place").first.click()
    expect(page.locator(".given li")).to_have_count(1)
    page.get_by_role("button", name="None of them").click()
    expect(page.locator(".proposal")).to_have_count(0)
    given = [each for each in unplaced if position(city, each)[0] is not None]
    assert len(given) == 1
    page.get_by_role("link", name="unplaced").first.click()
    expect(page.locator(".facts")).to_contain_text("Proposed with")
    page.locator(".facts").get_by_role("button", name="Undo").click()
    expect(page.locator(".facts")).not_to_contain_text("Proposed with")
    assert position(city, given[0]) == (None, None)


def test_photos_without_a_place_are_filtered_and_their_map_opens_at_look_alikes(
    visitor: Visitor, city: CityServer, unplaced: list[str]
) -> None:
    page = visitor.visit("photos")
    page.get_by_label("Without a place").check()
    expect(page.locator(".total")).to_have_text("2 photos")
    page = visitor.visit(f"photo/{unplaced[0]}")
    expect(page.locator("path.point.behind")).to_have_count(5)


def test_an_answer_to_a_stored_photo_is_put_there_and_taken_back(
    visitor: Visitor, city: CityServer, unplaced: list[str]
) -> None:
    page = visitor.visit(f"ask/{unplaced[0]}")
    page.get_by_role("button", name="Put this photo there").click()
    expect(page.get_by_text("The photo has this place now.")).to_be_visible()
    assert position(city, unplaced[0]) != (None, None)
    assert city.get(f"/uploads/{unplaced[0]}")["given_place"]["probability"] is None
    page.locator(".note").get_by_role("button", name="Undo").click()
    expect(page.get_by_text("1 place taken back.")).to_be_visible()
    assert position(city, unplaced[0]) == (None, None)


def test_a_wrong_answer_is_kept_without_a_place_and_taken_back(
    visitor: Visitor, city: CityServer, unplaced: list[str]
) -> None:
    def deny(page: Page) -> None:
        page.get_by_role("button", name="This is wrong").click()
        page.get_by_role("button", name="know").click()

    page = visitor.visit(f"ask/{unplaced[0]}")
    deny(page)
    expect(page.get_by_text("Kept: the photo was not taken there.")).to_be_visible()
    assert city.get(f"/uploads/{unplaced[0]}")["given_place"]["denied"]["radius_m"] > 0
    page = visitor.visit(f"photo/{unplaced[0]}")
    page.locator(".facts").get_by_role("button", name="Undo").click()
    expect(page.locator(".facts")).not_to_contain_text("A person said")
    assert city.get(f"/uploads/{unplaced[0]}")["given_place"] is None

    page = visitor.visit("ask")
    page.locator("input[data-use=ask]").set_input_files(city.queries[0])
    deny(page)
    expect(page.get_by_text("Kept as a test photo that was not taken there.")).to_be_visible()
    (kept,) = city.get("/search", filename=city.queries[0].name)["images"]
    assert (kept["role"], kept["latitude"]) == ("query", None)
    assert kept["given_place"]["denied"]["latitude"] is not None
    page.locator(".note").get_by_role("button", name="Undo").click()
    expect(page.get_by_text("The test photo is removed again.")).to_be_visible()
    assert city.get("/search", filename=city.queries[0].name)["total_found"] == 0
    visitor.expect_no_error()


def test_a_wrong_answer_becomes_a_test_photo_at_the_true_place_with_a_way_back(
    visitor: Visitor, city: CityServer
) -> None:
    page = visitor.visit("ask")
    page.locator("input[data-use=ask]").set_input_files(city.queries[0])
    page.get_by_role("button", name="This is wrong").click()
    page.get_by_role("button", name="Save").click()
    expect(page.get_by_role("dialog")).to_be_visible()  # nothing is chosen yet
    expect(page.get_by_role("dialog").locator("path.point").first).to_be_attached()
    page.get_by_role("dialog").locator(".ground").focus()
    page.keyboard.press("Enter")
    latitude = float(page.get_by_label("Latitude").input_value())
    page.get_by_role("button", name="Save").click()
    expect(page.get_by_text("Kept as a test photo")).to_be_visible()
    (kept,) = city.get("/search", filename=city.queries[0].name)["images"]
    assert (kept["role"], kept["latitude"]) == ("query", latitude)
    page.locator(".note").get_by_role("button", name="Undo").click()
    expect(page.get_by_text("The test photo is removed again.")).to_be_visible()
    assert city.get("/search", filename=city.queries[0].name)["total_found"] == 0
    visitor.expect_no_error()
