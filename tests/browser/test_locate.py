"""Locate a folder: proposals by the map and by time, accepted by probability, and downloaded."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path
from xml.etree import ElementTree

from PIL import Image
from playwright.sync_api import expect

from shared.ingest.photo_metadata import read_csv_manifest
from tests.browser.conftest import CityServer, Visitor
from tests.support.photos import camera_exif, photo_bytes

NOON = datetime(2026, 5, 1, 12, tzinfo=UTC)


def take_photo(
    picture: Path, path: Path, seconds: float, position: tuple[float, float] | None
) -> None:
    """Copy a picture as one of a camera, so many seconds after noon."""
    exif = camera_exif(NOON + timedelta(seconds=seconds), position, model="Camera")
    with Image.open(picture) as image:
        image.save(path, "JPEG", exif=exif)


def test_a_folder_is_located_accepted_by_probability_and_downloaded(
    visitor: Visitor, city: CityServer, tmp_path: Path
) -> None:
    stored = city.get("/search", role="database", limit=1)["images"][0]
    picture = tmp_path / "stored.jpg"
    picture.write_bytes(city.server.client.get(stored["image_url"]).content)
    position = (stored["latitude"], stored["longitude"])
    folder = tmp_path / "trip"
    folder.mkdir()
    take_photo(picture, folder / "known.jpg", 0, position)
    take_photo(picture, folder / "soon.jpg", 5, None)
    take_photo(city.queries[0], folder / "much later.jpg", 7200, None)
    (folder / "broken.jpg").write_bytes((folder / "soon.jpg").read_bytes()[:100])
    (folder / "empty.jpg").touch()

    page = visitor.visit("add")
    page.get_by_role("link", name="Locate a folder").click()
    page.locator("input[data-use=locate]").set_input_files(sorted(folder.iterdir()))
    expect(page.locator("tbody tr")).to_have_count(4)
    soon = page.locator("tr", has_text="soon.jpg")
    expect(soon).to_contain_text("accepted")
    expect(soon).to_contain_text("taken 5 s after known.jpg")
    expect(page.locator("tr", has_text="broken.jpg")).to_contain_text("cut off")
    expect(page.locator("tr", has_text="empty.jpg")).to_contain_text("The file is empty.")
    expect(page.locator(".chip.failed")).to_have_count(2)
    expect(page.locator("path.point.behind")).to_have_count(1)
    expect(page.locator("path.point.tracking").first).to_be_attached()

    with page.expect_download() as download:
        page.get_by_role("button", name="Download CSV").click()
    entries = read_csv_manifest(download.value.path().read_bytes(), "table")
    table = {entry.name: entry.fields for entry in entries}
    assert abs(float(table["soon.jpg"]["latitude"]) - position[0]) < 5e-4
    with page.expect_download() as download:
        page.get_by_role("button", name="Download GPX").click()
    names = [
        each.text for each in ElementTree.parse(download.value.path()).iter() if "name" in each.tag
    ]
    assert set(names) == table.keys()

    page.get_by_label("Accept from").fill("100")
    page.get_by_label("Accept from").blur()
    expect(page.get_by_role("button", name="Download CSV")).to_have_count(0)
    expect(page.get_by_text("4 photos without coordinates, 0 accepted").first).to_be_visible()
    visitor.expect_no_error()


def test_the_time_zone_and_the_error_of_the_clock_move_a_photo_along_the_track(
    visitor: Visitor, city: CityServer, tmp_path: Path
) -> None:
    nowhere = tmp_path / "nowhere.png"
    nowhere.write_bytes(photo_bytes(5, "PNG"))
    take_photo(nowhere, tmp_path / "walk.jpg", 0, None)  # at 12:00, without a time zone
    nowhere.unlink()
    (tmp_path / "walk.gpx").write_text(TRACK)
    page = visitor.visit("locate")
    page.get_by_label("Time zone of the cameras").select_option("UTC")
    page.locator("input[data-use=locate]").set_input_files(sorted(tmp_path.iterdir()))
    photo = page.locator("tr", has_text="walk.jpg")
    expect(photo).to_contain_text("45.00000, 7.12000")
    page.get_by_label("Time zone of the cameras").select_option("Europe/Rome")  # 10:00 UTC
    expect(photo).to_contain_text("45.00000, 7.10000")
    page.get_by_label("The clock was ahead by").fill("-3600")
    page.get_by_label("The clock was ahead by").blur()
    expect(photo).to_contain_text("45.00000, 7.11000")
    visitor.expect_no_error()


TRACK = (
    '<gpx xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>'
    + "".join(
        f'<trkpt lat="45" lon="7.{hour}"><time>2026-05-01T{hour}:00:00Z</time></trkpt>'
        for hour in (10, 11, 12)
    )
    + "</trkseg></trk></gpx>"
)
