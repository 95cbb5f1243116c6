"""A photo out of the browser: the page says what the API answers."""

from __future__ import annotations

import io
import itertools
import re
from pathlib import Path
from typing import Any

import pytest
from PIL import Image
from PIL.ExifTags import Base
from playwright.sync_api import Page, Route, expect

from tests.browser.conftest import CityServer, Visitor


def ask(visitor: Visitor, photo: Path, answer: Any = None) -> Page:
    """Ask with a photo; `answer` is what the API answers then, instead of its own."""
    if answer is not None:
        similarity = "**/api/v1/similarity?*"
        visitor.page.route(similarity, lambda route: route.fulfill(json=answer))
    page = visitor.visit("ask")
    page.locator("input[data-use=ask]").set_input_files(photo)
    expect(page.locator(".verdict")).to_be_visible()
    return page


def by_probability(found: dict[str, Any]) -> list[dict[str, Any]]:
    return sorted(found["similar_images"], key=lambda photo: -photo["match_probability"])


def strength(probability: float) -> str:
    return "strong" if probability >= 0.8 else "fair" if probability >= 0.3 else "weak"


def percent(probability: float) -> str:
    return f"{100 * probability:.1f} %"


def bands(levels: list[dict[str, Any]]) -> list[str]:
    """The names of the bars: the whole map ends the levels that are smaller than it."""
    circles = ["Within 25 m", "25 m to 100 m away", "100 m to 500 m away", "500 m to 2 km away"]
    whole = "Elsewhere in this map" if len(levels) > 1 else "In this map"
    return [*circles[: len(levels) - 1], whole, "Not in this map"]


@pytest.mark.parametrize("number", range(4))
def test_each_level_and_each_match_has_its_probability(
    visitor: Visitor, city: CityServer, number: int
) -> None:
    photo = city.queries[number]
    found = city.ask(photo)
    page = ask(visitor, photo)
    estimate, matches = found["estimate"], by_probability(found)
    probabilities = [level["probability"] for level in estimate["levels"]]
    if page.locator(".verdict.unknown").count():
        expect(page.locator(".levels, .rings")).to_have_count(0)
    else:
        rows = page.locator(".levels li")
        expect(rows.locator(".level")).to_have_text(bands(estimate["levels"]))
        bounds = [round(100 * probability) for probability in [0, *probabilities, 1]]
        shares = [after - before for before, after in itertools.pairwise(bounds)]
        expect(rows.locator(".figure")).to_have_text([f"{share} %" for share in shares])
        values = rows.locator("meter").evaluate_all("meters => meters.map(meter => meter.value)")
        assert values == shares
        assert sum(values) == 100
        page.locator(".verdict summary").click()
        name = "Probability: Within 25 m"
        expect(page.get_by_role("meter", name=name)).to_be_visible()
    expect(page.locator(".match")).to_have_count(len(matches))
    expect(page.locator(".match .figure")).to_have_text(
        [percent(match["match_probability"]) for match in matches]
    )
    words = [strength(match["match_probability"]) for match in matches]
    expect(page.locator(".match .strength")).to_have_text(words)
    page.locator(".figures summary").click()
    expect(page.locator(".figures tbody td:last-child")).to_have_text(
        [f"{match['similarity_score']:.3f}" for match in matches]
    )
    expect(page.locator(".number-pin")).to_have_count(len(matches))
    for share in (68, 95):
        ring = estimate[f"radius_{share}_m"]
        ring = None if page.locator(".verdict.unknown").count() else ring
        expect(page.locator(f"path.ring-{share}")).to_have_count(0 if ring is None else 1)
        expect(page.locator(f".rings .ring-{share}")).to_have_count(0 if ring is None else 1)


CENTER = {"latitude": 45.07, "longitude": 7.68}
WHOLE_MAP = {"place": None, "radius_m": None, "whole_map": True, "probability": 0.98}
CIRCLES = [
    {**CENTER, "place": None, "whole_map": False, "radius_m": 25, "probability": 0.51},
    {**CENTER, "place": None, "whole_map": False, "radius_m": 100, "probability": 0.97},
    {**CENTER, **WHOLE_MAP, "radius_m": 412},
]
UNPLACED = {"latitude": None, "longitude": None, "radius_m": None, "whole_map": False}
PATHS = [
    {**UNPLACED, "place": "tower/floor 7/elevator", "probability": 0.61},
    {**UNPLACED, "place": "tower/floor 7", "probability": 0.97},
    {**UNPLACED, **WHOLE_MAP},
]
CIRCLE, FLOOR = "45.07000, 7.68000", "tower/floor 7"


@pytest.mark.parametrize(
    ("levels", "answer", "in_map", "title", "place"),
    [
        (CIRCLES, 1, True, "In this map", CIRCLE),
        (PATHS, 1, True, "In this map", FLOOR),
        (PATHS, None, None, "Best guess", FLOOR),
        (CIRCLES, None, False, "Not in this map", None),
    ],
    ids=["circle", "path", "no certain level", "not in the map"],
)
def test_the_card_shows_the_headline_and_the_levels_that_it_stands_for(
    visitor: Visitor,
    city: CityServer,
    levels: list[dict[str, Any]],
    answer: int | None,
    in_map: bool | None,
    title: str,
    place: str | None,
) -> None:
    found = city.ask(city.queries[0])
    found["estimate"] |= {
        "headline": "The answer in one sentence: 97 %",
        "reason": "The reason.",
        "in_map": in_map,
        "has_place": in_map is not False,
        **(CENTER if place == CIRCLE else {"latitude": None, "longitude": None}),
        "place": FLOOR if place == FLOOR else None,
        "levels": levels,
        "answer_level": answer,
        "certainty": 0.95,
        "not_in_map_probability": 0.02,
        "radius_68_m": 42.4 if levels is CIRCLES else None,
        "radius_95_m": None,
    }
    page = ask(visitor, city.queries[0], found)
    expect(page.locator(".badge")).to_have_text(title)
    expect(page.locator(".headline")).to_have_text("The answer in one sentence: 97 %")
    expect(page.locator(".verdict .place")).to_have_text([place] if place else [])
    expect(page.locator(".reason")).to_have_text("The reason.")
    names = [CIRCLES_NAMES, PATHS_NAMES][levels is PATHS] if in_map is not False else []
    expect(page.locator(".levels .level")).to_have_text(names)
    expect(page.locator(".levels .chosen")).to_have_count(0 if answer is None else answer + 1)
    rings = ["68 %: within 42 m"] if levels is CIRCLES and place else []
    expect(page.locator(".rings li")).to_have_text(rings)
    expect(page.locator("path.ring-68")).to_have_count(len(rings))
    expect(page.locator("path.ring-95, path.estimate")).to_have_count(0)


CIRCLES_NAMES = ["Within 25 m", "25 m to 100 m away", "Elsewhere in this map", "Not in this map"]
PATHS_NAMES = [
    "tower/floor 7/elevator", "Elsewhere in tower/floor 7", "Elsewhere in this map",
    "Not in this map",
]  # fmt: skip


NO_LEVELS: dict[str, Any] = {
    "in_map": None,
    "levels": [],
    "answer_level": None,
    "not_in_map_probability": None,
    "radius_68_m": None,
    "radius_95_m": None,
    "calibration_source": None,
}


def test_a_guess_has_no_error_until_the_map_is_measured_and_is_then_answered_again(
    visitor: Visitor, city: CityServer
) -> None:
    found = city.ask(city.queries[0])
    guess = found["estimate"] | NO_LEVELS | {**CENTER, "has_place": True}
    measured = found["estimate"] | {"levels": CIRCLES, "answer_level": 1, "reason": "Measured."}
    described = city.get("/maps/riverside")
    states = ["too_few_photos", "not_measured", "running", "measured"]
    reached = 0

    def answer(route: Route) -> None:
        estimate = measured if states[reached] == "measured" else guess
        route.fulfill(json=found | {"estimate": estimate})

    def measure(route: Route) -> None:
        nonlocal reached
        reached = 2
        route.fulfill(status=202, json={})

    page = visitor.page
    page.route("**/api/v1/similarity?*", answer)
    page.route("**/api/v1/evaluations?*", measure)
    page.route(
        "**/api/v1/maps/riverside*",
        lambda route: route.fulfill(
            json=described | {"measurement": states[reached], "located": 7}
        ),
    )
    ask(visitor, city.queries[0])
    expect(page.locator(".badge")).to_have_text("Best guess")
    expect(page.locator(".verdict .place")).to_have_text("45.07000, 7.68000")
    expect(page.locator(".verdict .radius, .levels, path.ring-68")).to_have_count(0)
    expect(page.locator(".reason")).to_contain_text("that takes 20 photos with coordinates")
    expect(page.locator(".reason")).to_contain_text("this map has 7")
    reached = 1
    page.get_by_role("button", name="Measure now").click()
    expect(page.locator(".reason")).to_have_text("The certainty of answers is being measured now.")
    assert "POST" not in page.locator(".verdict").inner_text()
    reached = 3
    expect(page.locator(".reason")).to_contain_text("Measured.")


def test_photos_without_a_place_keep_their_rank_and_are_counted(
    visitor: Visitor, city: CityServer
) -> None:
    found = city.ask(city.queries[0])
    first, *others = found["similar_images"]
    first |= {"latitude": None, "longitude": None, "place": None, "match_probability": None}
    first["original_filename"] = "without.jpg"
    found |= {"matches_without_place": 1}
    page = ask(visitor, city.queries[0], found)
    expect(page.locator(".verdict")).to_contain_text(
        "1 of these 12 photos has neither coordinates nor a label."
    )
    expect(page.locator(".match").first).to_contain_text("no coordinates or label")
    expect(page.locator(".match .strength")).to_have_count(len(others))


def test_an_empty_map_finds_nothing_and_recommends_no_vocabulary(
    visitor: Visitor, city: CityServer
) -> None:
    found = city.ask(city.queries[0]) | {"similar_images": [], "vocabulary": "foreign"}
    found["estimate"] |= {"levels": [], "in_map": None, "latitude": None, "place": None}
    found["estimate"] |= {"answer_level": None, "not_in_map_probability": None}
    page = ask(visitor, city.queries[0], found)
    expect(page.get_by_role("heading", name="No photo found")).to_be_visible()
    expect(page.locator(".verdict .hint")).to_have_count(0)


def test_an_answer_without_a_place_is_not_shown_as_a_guess(
    visitor: Visitor, city: CityServer
) -> None:
    found = city.ask(city.queries[0])
    found["estimate"] |= {
        **NO_LEVELS,
        **UNPLACED,
        "place": None,
        "has_place": False,
        "reason": "None has a place.",
    }
    for photo in found["similar_images"]:
        photo |= {"latitude": None, "place": None, "match_probability": None}
    found["matches_without_place"] = len(found["similar_images"])
    page = ask(visitor, city.queries[0], found)
    expect(page.locator(".badge")).to_have_text("No estimate")
    expect(page.locator(".reason")).to_have_text("None has a place.")
    page.locator(".figures summary").click()
    expect(page.locator(".figures p")).to_contain_text("in the order of their similarity")
    expect(page.locator(".figures thead")).to_contain_text("Similarity")
    expect(page.locator(".figures thead")).not_to_contain_text("Same place")


def test_long_names_of_matches_stay_on_a_narrow_phone(visitor: Visitor, city: CityServer) -> None:
    found = city.ask(city.queries[0])
    for photo in found["similar_images"]:
        name = {"original_filename": "a_name_without_a_space_" * 4 + ".jpg", "relative_path": None}
        photo |= {**name, "latitude": None, "place": "building/floor_7/" * 4}
    visitor.page.set_viewport_size({"width": 320, "height": 640})
    page = ask(visitor, city.queries[0], found)
    page.locator(".figures summary").click()
    assert page.evaluate("document.documentElement.scrollWidth") <= 320


def test_a_large_photo_is_sent_as_a_small_upright_copy_and_gets_the_same_answer(
    visitor: Visitor, city: CityServer, tmp_path: Path
) -> None:
    sideways = Image.Exif()
    sideways[Base.Orientation] = 6
    large = tmp_path / "large.jpg"
    with Image.open(city.queries[0]) as photo:
        upright = photo.resize((5000, round(5000 * photo.height / photo.width)))
    upright.transpose(Image.Transpose.ROTATE_90).save(large, quality=95, exif=sideways)
    sent: list[bytes] = []

    def record(route: Route) -> None:
        sent.append(route.request.post_data_buffer or b"")
        route.continue_()

    visitor.page.route("**/api/v1/similarity?*", record)
    page = ask(visitor, large)
    assert len(sent[0]) < large.stat().st_size / 2
    with Image.open(io.BytesIO(sent[0][sent[0].index(b"\xff\xd8") :])) as small:
        assert small.size == (2048, round(2048 * upright.height / upright.width))
        assert not small.getexif()
    # The order of photos of one place, which have one probability, may differ.
    matches = by_probability(city.ask(large))
    likeliest = matches[0]["match_probability"]
    best = {
        match["original_filename"]: match["similarity_score"]
        for match in matches
        if match["match_probability"] == likeliest
    }
    page.locator(".figures summary").click()
    row = page.locator(".figures tbody tr").first.locator("td")
    name = row.nth(1).inner_text()
    assert name in best
    assert float(row.last.inner_text()) == pytest.approx(best[name], abs=0.05)


def test_a_pasted_photo_is_a_query(visitor: Visitor, city: CityServer) -> None:
    page = visitor.visit("ask")
    expect(page.locator(".mosaic")).to_be_visible()
    page.evaluate(
        """bytes => {
            const data = new DataTransfer();
            data.items.add(new File([new Uint8Array(bytes)], "pasted.jpg", { type: "image/jpeg" }));
            document.dispatchEvent(new ClipboardEvent("paste", { clipboardData: data }));
        }""",
        list(city.queries[0].read_bytes()),
    )
    expect(page.locator(".verdict")).to_be_visible()
    expect(page.locator(".query-photo figcaption")).to_have_text("pasted.jpg")


def test_the_page_shows_the_result_of_the_later_of_two_queries(
    visitor: Visitor, city: CityServer
) -> None:
    page = visitor.visit("ask")
    held: list[Route] = []
    page.route("**/api/v1/similarity?*", lambda route: held.append(route), times=1)
    with page.expect_request("**/api/v1/similarity?*"):
        page.locator("input[data-use=ask]").set_input_files(city.queries[0])
    page.locator("input[data-use=ask]").set_input_files(
        {"name": "later.jpg", "mimeType": "image/jpeg", "buffer": city.queries[1].read_bytes()}
    )
    expect(page.locator(".query-photo figcaption")).to_have_text("later.jpg")
    with page.expect_response("**/api/v1/similarity?*"):
        held[0].continue_()
    page.wait_for_load_state("networkidle")
    expect(page.locator(".query-photo figcaption")).to_have_text("later.jpg")


def test_a_file_that_is_no_photo_is_rejected_with_the_reason(visitor: Visitor) -> None:
    page = visitor.visit("ask")
    page.locator("input[data-use=ask]").set_input_files(
        {"name": "notes.txt", "mimeType": "text/plain", "buffer": b"no photo" * 20}
    )
    expect(page.get_by_role("heading", name="No answer")).to_be_visible()
    expect(page.locator(".refused")).to_contain_text("JPEG")


def test_a_match_is_shown_beside_the_photo_with_lines_between_their_points(
    visitor: Visitor, city: CityServer
) -> None:
    page = ask(visitor, city.queries[0])
    match = page.locator(".match").first
    expect(match.locator(".match-points")).to_have_text(re.compile(r"^\d+ matching points?$"))
    points = int(match.locator(".match-points").inner_text().split()[0])
    assert f"{points} matching point" in (match.get_attribute("aria-label") or "")
    match.click()
    dialog = page.get_by_role("dialog")
    expect(dialog.locator(".frame")).to_have_count(2)
    caption = f"{points} points of both photos match."
    expect(dialog.get_by_role("status")).to_have_text(caption)
    expect(dialog.get_by_role("img", name=caption)).to_be_visible()
    lines = dialog.locator(".lines line")
    expect(lines).to_have_count(min(points, 30))
    dialog.get_by_label("Lines").select_option("at most 150")
    expect(lines).to_have_count(min(points, 150))
    left, right = (dialog.locator(".frame img").nth(side).bounding_box() for side in (0, 1))
    assert left
    assert right
    # At once, because the lines are drawn anew when a photo is loaded.
    drawn = lines.evaluate_all(
        """(lines) => lines.map((line) => {
        const box = line.ownerSVGElement.getBoundingClientRect();
        return ["1", "2"].map((end) => ["x", "y"].map((axis) =>
          line[axis + end].baseVal.value + box[axis])); })"""
    )
    for ends in drawn:
        for (x, y), photo in zip(ends, (left, right), strict=True):
            assert photo["x"] - 1 <= x <= photo["x"] + photo["width"] + 1
            assert photo["y"] - 1 <= y <= photo["y"] + photo["height"] + 1
    dialog.get_by_label("Lines").select_option("none")
    expect(lines).to_have_count(0)
    dialog.get_by_role("heading").focus()
    page.keyboard.press("ArrowRight")
    expect(dialog.get_by_role("heading")).to_have_text("Match 2 of 12")
    expect(dialog.get_by_role("status")).to_contain_text("points of both photos match")
    page.keyboard.press("Escape")
    expect(dialog).to_have_count(0)


def test_no_lines_cover_the_photos_on_a_phone(visitor: Visitor, city: CityServer) -> None:
    visitor.page.set_viewport_size({"width": 390, "height": 844})
    page = ask(visitor, city.queries[0])
    page.locator(".match").first.click()
    dialog = page.get_by_role("dialog")
    expect(dialog.get_by_label("Lines")).to_have_value("0")
    expect(dialog.locator(".lines line")).to_have_count(0)


def test_the_answer_names_the_folder_and_the_day_of_the_best_match(
    visitor: Visitor, city: CityServer
) -> None:
    found = city.ask(city.queries[0])
    found["estimate"] |= {"in_map": True}
    best = max(found["similar_images"], key=lambda photo: photo["match_probability"] or 0)
    best |= {"relative_path": "Sommer 2025/a.jpg", "captured_at": "2025-06-18T23:30:00Z"}
    best["match_probability"] = 1.0
    page = ask(visitor, city.queries[0], found)
    expect(page.locator(".looks-like")).to_have_text("Looks like Sommer 2025, 18 June 2025")


def test_a_photo_of_the_map_finds_its_neighbours_and_not_itself(
    visitor: Visitor, city: CityServer
) -> None:
    stored = city.get("/search", role="database", limit=1)["images"][0]
    page = visitor.visit(f"ask/{stored['image_id']}")
    expect(page.locator(".match")).to_have_count(12)
    assert stored["original_filename"] not in page.locator(".matches").inner_text()


def test_an_empty_map_says_what_to_do_next(visitor: Visitor) -> None:
    page = visitor.page
    page.goto(visitor.url)
    page.evaluate("localStorage.setItem('placewise-map', 'default')")
    visitor.visit("ask")
    expect(page.get_by_text("by comparing it with photos whose place is known")).to_be_visible()
    page.get_by_role("link", name="Add photos").click()
    expect(page.get_by_role("heading", name="Add photos")).to_be_visible()
