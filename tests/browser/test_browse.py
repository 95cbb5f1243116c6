"""Finding, changing and deleting the map's photos."""

from __future__ import annotations

from playwright.sync_api import Dialog, expect

from tests.browser.conftest import MAP, CityServer, Visitor
from tests.support.photos import photo_bytes

COVERED_LABELS = """() => {
    const covers = [...document.querySelectorAll(".streets-button, .leaflet-control-scale-line")];
    const boxes = covers.map((element) => element.getBoundingClientRect());
    return [...document.querySelectorAll(".graticule-label")].filter((label) => {
        const { left, right, top, bottom } = label.getBoundingClientRect();
        return boxes.some((box) =>
            left < box.right && right > box.left && top < box.bottom && bottom > box.top);
    }).map((label) => label.textContent);
}"""


def bring_in(city: CityServer, *names: str) -> list[str]:
    """Photos of the map `riverside` that no other test counts on; their ids."""
    ids = []
    for name in names:
        number = sum(map(ord, name))
        fields = {"role": "query", "latitude": 44, "longitude": 8.7, "tags": "first"}
        ids.append(city.server.indexed(photo_bytes(number), name, MAP, **fields))
    return ids


def test_photos_are_filtered_by_name_tag_and_place(visitor: Visitor, city: CityServer) -> None:
    page = visitor.visit("photos")
    everything = city.get("/search", limit=1)["total_found"]
    expect(page.locator(".total")).to_have_text(f"{everything} photos")
    page.get_by_label("Name").fill("SPRING")
    spring = city.get("/search", filename="spring", limit=1)["total_found"]
    assert 0 < spring < everything
    expect(page.locator(".total")).to_have_text(f"{spring} photos")
    page.get_by_label("Name").fill("")
    page.get_by_text("More filters").click()
    some = city.get("/search", role="database", limit=1)["images"][0]
    page.get_by_label("Near").fill(f"{some['latitude']}, {some['longitude']}")
    page.get_by_label("Within metres").fill("30")
    near = city.get("/search", near=f"{some['latitude']},{some['longitude']},30", limit=1)
    assert 0 < near["total_found"] < everything
    expect(page.locator(".photo-card")).to_have_count(near["total_found"])
    page.get_by_label("Name").fill("no such photo")
    expect(page.get_by_role("heading", name="No photo matches the filter")).to_be_visible()


def test_photos_are_sorted_by_when_they_were_taken_below_the_names_of_their_folders(
    visitor: Visitor, city: CityServer
) -> None:
    ids = bring_in(city, "sorted-1.jpg", "sorted-2.jpg", "sorted-3.jpg")
    for number, photo_id in enumerate(ids[:2]):
        changed = {
            "captured_at": f"2025-06-{18 - number}T12:00:00Z",
            "relative_path": "Day 1/x.jpg",
        }
        city.server.client.patch(
            f"/api/v1/uploads/{photo_id}", params={"map": MAP}, json=changed
        ).raise_for_status()
    page = visitor.visit("photos")
    expect(page.get_by_role("heading", name="Day 1")).to_be_visible()
    page.get_by_role("button", name="Only this folder").first.click()
    expect(page.locator(".photo-card")).to_have_count(2)
    page.get_by_label("Order").select_option("taken")
    expect(page.locator(".photo-card").first).to_contain_text("18 June 2025")
    expect(page.locator(".photo-card").last).to_contain_text("17 June 2025")
    for photo_id in ids:
        params = {"map": MAP, "permanently": "true"}
        city.server.client.delete(f"/api/v1/uploads/{photo_id}", params=params)


def test_the_map_shows_where_photos_are_and_takes_a_point(visitor: Visitor) -> None:
    page = visitor.visit("photos")
    # While the map is being loaded, the photos are requested again.
    page.get_by_label("Tags").fill("spring")
    page.get_by_role("button", name="Show the map").click()
    expect(page.locator("path.point").first).to_be_attached()
    expect(page.locator(".graticule-label").first).to_be_visible()
    assert page.evaluate(COVERED_LABELS) == []
    page.locator(".ground").focus()
    page.keyboard.press("Enter")
    expect(page.get_by_label("Near")).not_to_have_value("")
    expect(page.locator("path.estimate")).to_have_count(1)
    visitor.expect_no_error()


def test_chosen_photos_are_tagged_removed_and_restored(visitor: Visitor, city: CityServer) -> None:
    ids = bring_in(city, "tagged-one.jpg", "tagged-two.jpg")
    page = visitor.visit("photos")
    page.get_by_label("Name").fill("tagged-")
    expect(page.locator(".photo-card")).to_have_count(2)
    for box in page.locator(".photo-card").get_by_role("checkbox").all():
        box.check()
    page.get_by_role("button", name="Tag…").click()
    page.get_by_label("Tags to add").fill("second, third")
    page.get_by_role("button", name="Add", exact=True).click()
    expect(page.locator(".photo-card .chips").first).to_contain_text("third")
    assert city.get(f"/uploads/{ids[0]}")["tags"] == ["first", "second", "third"]

    page.locator(".photo-card").get_by_role("checkbox").first.check()
    page.get_by_role("button", name="Remove").click()
    expect(page.locator(".photo-card")).to_have_count(1)
    assert city.get("/search", filename="tagged-")["total_found"] == 1
    page.locator(".note").get_by_role("button", name="Undo").click()
    expect(page.locator(".photo-card")).to_have_count(2)
    assert city.get("/search", filename="tagged-")["total_found"] == 2


def test_a_photo_is_moved_and_named_and_shows_no_rounding_errors(
    visitor: Visitor, city: CityServer
) -> None:
    (photo_id,) = bring_in(city, "moved.jpg")
    city.server.client.patch(
        f"/api/v1/uploads/{photo_id}", params={"map": MAP}, json={"longitude": 8.700000000000001}
    ).raise_for_status()
    page = visitor.visit(f"photo/{photo_id}")
    expect(page.get_by_label("Longitude")).to_have_value("8.7")
    page.on("dialog", Dialog.dismiss)
    page.get_by_label("Latitude").fill("44.5")
    page.get_by_label("Place").fill("Harbour <b>wall</b>")
    page.get_by_role("button", name="Save").click()
    expect(page.locator(".note")).to_contain_text("Saved.")
    reported = city.get(f"/uploads/{photo_id}")
    assert (reported["latitude"], reported["place"]) == (44.5, "Harbour <b>wall</b>")
    page.get_by_label("Latitude").fill("")
    page.get_by_role("button", name="Save").click()
    expect(page.locator(".note.bad")).to_be_visible()
    assert city.get(f"/uploads/{photo_id}")["latitude"] == 44.5
    visitor.visit("photos")
    page.get_by_label("Name").fill("moved.jpg")
    expect(page.locator(".photo-name").first).to_have_text("Harbour <b>wall</b>")


def test_a_removed_photo_is_restored_from_the_trash_or_deleted_for_good(
    visitor: Visitor, city: CityServer
) -> None:
    (photo_id,) = bring_in(city, "gone.jpg")
    page = visitor.visit(f"photo/{photo_id}")
    page.get_by_role("button", name="Remove").click()
    expect(page.get_by_role("heading", name="Photos")).to_be_visible()
    gone = city.server.client.get(f"/api/v1/uploads/{photo_id}", params={"map": MAP})
    assert gone.status_code == 404

    page.get_by_role("link", name="Trash").click()
    card = page.locator(".photo-card", has_text="gone.jpg")
    card.get_by_role("button", name="Restore").click()
    expect(card).to_have_count(0)
    assert city.get(f"/uploads/{photo_id}")["latitude"] == 44.0

    city.server.client.delete(f"/api/v1/uploads/{photo_id}", params={"map": MAP})
    visitor.visit("trash")
    card.get_by_role("button", name="Delete for good…").click()
    page.get_by_role("button", name="Keep").click()
    expect(card).to_have_count(1)
    card.get_by_role("button", name="Delete for good…").click()
    page.get_by_role("button", name="Delete for good", exact=True).click()
    expect(card).to_have_count(0)
    assert city.get("/search", removed=True, filename="gone")["total_found"] == 0

    for photo_id in bring_in(city, "gone.jpg", "gone-too.jpg"):
        city.server.client.delete(f"/api/v1/uploads/{photo_id}", params={"map": MAP})
    visitor.visit("trash")
    page.get_by_role("button", name="Empty the trash…").click()
    expect(page.get_by_role("dialog")).to_contain_text("photos and their bytes are deleted")
    page.get_by_role("button", name="Delete for good", exact=True).click()
    expect(page.locator(".total")).to_have_text("The trash is empty.")
    assert city.get("/search", removed=True)["total_found"] == 0
