"""Poses on the page: a cone on the map, and the points that were seen in the photo."""

from __future__ import annotations

from typing import Any

import pytest
from playwright.sync_api import FloatRect, Locator, Page, expect

from tests.browser.conftest import CityServer, Visitor
from tests.browser.test_ask import ask
from tests.support.api_responses import POSE


def box(element: Locator) -> FloatRect:
    found = element.bounding_box()
    assert found is not None
    return found


def ask_with_pose(visitor: Visitor, city: CityServer, **fields: Any) -> Page:
    """The answer of the API with a pose at its best photo that looks east, with a wide view.

    The other photos are near, so that the map shows metres.
    """
    found = city.ask(city.queries[0])
    best = found["similar_images"][0]
    place = {"latitude": best["latitude"], "longitude": best["longitude"]}
    found["similar_images"] = [photo | place for photo in found["similar_images"]]
    found["estimate"] |= {"radius_68_m": 20.0, "radius_95_m": None}
    camera = {**POSE["camera"], "width": 480, "height": 360, "focal_pixels": 240}
    seen = [{"query": pixel, "point": [0, 0, 0]} for pixel in ([240, 180], [240, 90])]
    pose = {**POSE, **place, "heading": 90.0, "camera": camera, "seen": seen, **fields}
    return ask(visitor, city.queries[0], found | {"pose": pose, "no_pose": None})


def test_pose_is_said_and_drawn_as_a_cone_with_its_radius_and_the_points_seen(
    visitor: Visitor, city: CityServer
) -> None:
    page = ask_with_pose(visitor, city)
    expect(page.locator(".pose")).to_contain_text(" ± 0.4 m (68 %) and looked E, 90° ± 1°")
    expect(page.locator("path.pose-68, path.pose-95")).to_have_count(2)
    cone, ring = box(page.locator("path.pose-cone")), box(page.locator("path.pose-95"))
    middle = ring["x"] + ring["width"] / 2
    assert cone["width"] > 20
    assert cone["x"] == pytest.approx(middle, abs=2)
    assert cone["height"] == pytest.approx(2 * 0.71 * cone["width"], rel=0.1), "90 degrees wide"
    photo = box(page.locator(".query-photo img"))
    expect(page.locator(".seen circle")).to_have_count(2)
    centres = [
        (dot["x"] + dot["width"] / 2, dot["y"] + dot["height"] / 2)
        for dot in (box(page.locator(".seen circle").nth(number)) for number in range(2))
    ]
    x, y = photo["x"] + photo["width"] / 2, photo["y"] + photo["height"] / 2
    scale = max(photo["width"] / 480, photo["height"] / 360)  # it fills its frame
    assert centres[0] == pytest.approx((x, y), abs=1)
    assert centres[1] == pytest.approx((x, y - 90 * scale), abs=1)


def test_missing_poses_and_coordinates_are_explained_in_the_details(
    visitor: Visitor, city: CityServer
) -> None:
    fields = dict.fromkeys(["latitude", "longitude", "radius_68_m", "radius_95_m", "heading"])
    page = ask_with_pose(visitor, city, **fields, reason="All photos are on a line.")
    page.locator(".verdict summary").last.click()
    expect(page.locator(".verdict .facts")).to_contain_text("All photos are on a line.")
    expect(page.locator(".pose, path.pose-cone")).to_have_count(0)
    expect(page.locator(".seen circle")).to_have_count(2)
    visitor.page.unroute_all()
    page = ask(visitor, city.queries[0])
    page.locator(".verdict summary").last.click()
    expect(page.locator(".verdict .facts")).to_contain_text("no reconstruction yet")
    expect(page.locator(".seen")).to_have_count(0)
