"""Fitting a vocabulary on the page, and seeing what it has gained."""

from __future__ import annotations

import re

from playwright.sync_api import Route, expect

from tests.browser.conftest import MAP, CityServer, Visitor
from tests.support.exported import SIDE, tiny_onnx


def test_a_vocabulary_is_fitted_with_a_bar_and_compared_with_the_one_before(
    visitor: Visitor, city: CityServer
) -> None:
    page = visitor.visit("model")
    expect(page.locator(".standing .chip")).to_have_text("Foreign")
    page.get_by_role("button", name="Fit a vocabulary…").click()
    page.get_by_label("Photos to fit on, at most").fill("60")
    page.get_by_role("button", name="Fit it", exact=True).click()
    expect(page.get_by_role("progressbar", name="Improving the map")).to_be_visible()
    expect(page.locator(".standing .chip")).to_have_text("Its own")
    assert city.get(f"/maps/{MAP}")["vocabulary"] == "own"

    page.get_by_role("button", name="Measure now").click()
    expect(page.get_by_role("heading", name="Before and after")).to_be_visible()
    before, after = reversed(
        [one["figures"]["leave_one_out"]["R@1"] for one in _newest_of_each(city)]
    )
    shown = page.locator("table.recalls").last.locator("tbody tr").first
    expect(shown.locator("td").nth(0)).to_contain_text(f"{100 * before:.1f} %")
    expect(shown.locator("td").nth(1)).to_contain_text(f"{100 * after:.1f} %")
    vocabularies = city.get("/vocabularies")
    with page.expect_download() as download:
        page.get_by_role("button", name="Download").first.click()
    assert download.value.suggested_filename == f"{vocabularies[0]['vocabulary_id']}.npz"


def test_every_view_says_that_the_map_is_being_improved(visitor: Visitor, city: CityServer) -> None:
    finished = city.get("/jobs", kind="evaluate", limit=1)["jobs"][0]
    fit = {**finished, "kind": "fit", "label": "Improving the map", "state": "running"}
    fit |= {"stage": "describe", "progress": {"done": 40, "total": 100, "failed": 0}}
    visitor.page.route(
        re.compile(r"/api/v1/jobs\?.*kind=fit&state="),
        lambda route: route.fulfill(json={"jobs": [fit], "next_cursor": None}),
    )
    line = visitor.visit("photos").locator("#improving")
    expect(line).to_have_text("Improving the map: describing, 40.0 %")
    line.click()
    expect(visitor.page.get_by_role("heading", name="Model in use")).to_be_visible()


def test_automatic_fits_are_switched_on_and_off(visitor: Visitor, city: CityServer) -> None:
    page = visitor.visit("model")
    switch = page.get_by_role("checkbox", name="Improve this map automatically")
    expect(switch).not_to_be_checked()
    page.locator("#map-choice").select_option("default")
    expect(switch).to_be_checked()
    next_fit = page.get_by_text("next time at 50 photos")
    expect(next_fit).to_be_visible()
    switch.uncheck()
    expect(next_fit).to_have_count(0)
    assert city.get("/maps/default")["auto_fit"] is False
    switch.check()
    expect(next_fit).to_be_visible()
    assert city.get("/maps/default")["auto_fit"] is True


def _newest_of_each(city: CityServer) -> list[dict[str, dict[str, dict[str, float]]]]:
    newest: dict[str, dict[str, dict[str, dict[str, float]]]] = {}
    for one in city.get("/evaluations")["evaluations"]:
        newest.setdefault(one["generation_id"], one)
    assert len(newest) == 2
    return list(newest.values())


def test_a_second_model_change_is_refused_in_words_of_the_page(visitor: Visitor) -> None:
    refused = {"code": "model_change_running", "detail": "Cancel it: POST /api/v1/jobs/1/cancel."}
    visitor.page.route(
        "**/api/v1/vocabularies?*",
        lambda route: (
            route.fulfill(status=409, json=refused)
            if route.request.method == "POST"
            else route.fallback()
        ),
    )
    page = visitor.visit("model")
    page.get_by_role("button", name="Fit").first.click()
    page.get_by_role("button", name="Fit it", exact=True).click()
    expect(page.locator(".note.bad")).to_contain_text("cancel it under Advanced")


def test_a_comparison_stays_on_a_narrow_phone(visitor: Visitor) -> None:
    def two_generations(route: Route) -> None:
        [after, *_] = route.fetch().json()["evaluations"]
        route.fulfill(json={"evaluations": [after, {**after, "generation_id": "another"}]})

    visitor.page.route("**/api/v1/evaluations?*", two_generations)
    visitor.page.set_viewport_size({"width": 320, "height": 640})
    page = visitor.visit("model")
    expect(page.get_by_role("heading", name="Before and after")).to_be_visible()
    assert page.evaluate("document.documentElement.scrollWidth") <= 320


def test_labels_can_be_set_to_names_and_back_to_automatic(
    visitor: Visitor, city: CityServer
) -> None:
    page = visitor.visit("model")
    labels = page.get_by_label("Labels")
    expect(labels).to_have_value("auto")
    for value, automatic in (("false", False), ("auto", True)):
        labels.select_option(value)
        expect(page.locator(".note").first).to_contain_text("Saved.")
        page.locator(".note button").first.click()
        described = city.get(f"/maps/{MAP}")
        assert described["place_labels_are_automatic"] is automatic
        assert described["place_labels_are_paths"] is False


def test_the_share_of_queries_from_elsewhere_is_set_in_percent(
    visitor: Visitor, city: CityServer
) -> None:
    page = visitor.visit("model")
    share = page.get_by_label("Queries from elsewhere")
    expect(share).to_have_value("33")
    for percent in (5, 33):
        share.fill(str(percent))
        share.press("Enter")
        expect(page.locator(".note").first).to_contain_text("Saved.")
        page.locator(".note button").first.click()
        assert city.get(f"/maps/{MAP}")["elsewhere"] == percent / 100


def test_status_shows_the_parts_the_map_and_the_newest_jobs(
    visitor: Visitor, city: CityServer
) -> None:
    page = visitor.visit("status")
    expect(page.locator(".parts li")).to_have_count(6)
    expect(page.locator(".card .chip.healthy")).to_have_text("healthy")
    photos = city.get("/database/stats")["total_images"]
    expect(page.locator(".tile").first).to_contain_text(str(photos))
    expect(page.get_by_text("The certainty of answers is measured.")).to_be_visible()
    expect(page.get_by_role("heading", name="Newest jobs")).to_be_visible()
    expect(page.locator("time").first).to_contain_text(re.compile("just now|ago"))


def test_a_question_in_the_history_has_the_title_of_its_answer(
    visitor: Visitor, city: CityServer
) -> None:
    city.ask(city.queries[0])
    entry = city.get("/searches?limit=1")["searches"][0]
    titles = {
        (True, 1, 0.02, True): "In this map",
        (False, None, 0.7, False): "Not in this map",
        (None, None, 0.3, True): "Best guess",
        (None, None, None, False): "No estimate",
    }
    fields = ("in_map", "answer_level", "not_in_map_probability", "has_place")
    searches = [entry | dict(zip(fields, values, strict=True)) for values in titles]
    visitor.page.route(
        "**/api/v1/searches?*",
        lambda route: route.fulfill(json={"searches": searches, "next_cursor": None}),
    )
    history = visitor.visit("status").get_by_role("group", name="Newest questions")
    expect(history.locator("tbody .chip")).to_have_text(list(titles.values()))


def test_a_phone_gets_the_address_as_a_code_where_it_can_reach_the_server(
    visitor: Visitor,
) -> None:
    page = visitor.visit("status")
    expect(page.get_by_text("make run HOST=0.0.0.0")).to_be_visible()

    def on_a_network(route: Route) -> None:
        settings = route.fetch().json()
        route.fulfill(json={**settings, "lan_url": "http://192.168.1.23:8000"})

    page.route("**/console/settings.json", on_a_network)
    page = visitor.visit("status")
    expect(page.get_by_role("link", name="http://192.168.1.23:8000")).to_be_visible()
    code = page.get_by_alt_text("QR code of http://192.168.1.23:8000")
    assert code.evaluate("(image) => image.decode().then(() => image.naturalWidth)") > 100


def test_a_new_map_is_created_and_selected(visitor: Visitor, city: CityServer) -> None:
    page = visitor.visit("photos")
    page.locator("#map-choice").select_option(label="New map…")
    page.get_by_label("Name").last.fill("old-city")
    page.get_by_role("button", name="Create").click()
    expect(page.get_by_role("heading", name="This map has no photos yet")).to_be_visible()
    expect(page.locator("#map-choice")).to_have_value("old-city")
    assert "old-city" in [one["name"] for one in city.server.client.get("/api/v1/maps").json()]


def test_added_models_are_listed_and_can_be_switched_to(visitor: Visitor, city: CityServer) -> None:
    options = f"input.size={SIDE}x{SIDE}"
    form = {"name": "tiny", "licence": "MIT", "options": options}
    started = city.server.client.post(
        "/api/v1/models", data=form, files={"file": ("net.onnx", tiny_onnx())}
    )
    finished = city.server.finished(started.json()["job_id"])
    assert finished["state"] == "succeeded", finished
    page = visitor.visit("model")
    row = page.get_by_role("group", name="Added models").locator("tbody tr")
    expect(row).to_contain_text(f"onnx:tiny:{options}")
    expect(row).to_contain_text("MIT")
    refused = {"code": "model_change_running", "detail": "Another change is running."}
    page.route(
        "**/api/v1/generations*",
        lambda route: route.fulfill(status=409, json=refused),
    )
    with page.expect_request("**/api/v1/generations*") as sent:
        row.get_by_role("button", name="Switch to it").click()
    assert sent.value.post_data_json == {"extractor": f"onnx:tiny:{options}"}
    assert city.server.client.delete("/api/v1/models/tiny").is_success
