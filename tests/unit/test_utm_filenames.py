"""Places and times in @UTM@ file names."""

from __future__ import annotations

import pytest

from shared.errors import InvalidRequest
from shared.utm_filenames import upload_fields_of_file_name

EAST, NORTH = "0396877.76", "4991561.25"
NO_FIELDS = "@" * 13


def test_degrees_of_a_name_go_before_its_metres() -> None:
    name = f"@{EAST}@{NORTH}@32@T@45.0691@7.6931@pano@tile@370.5@@@@@@.jpg"
    expected = {"latitude": "45.0691", "longitude": "7.6931", "heading": "10.5"}
    assert upload_fields_of_file_name(name, None) == expected


@pytest.mark.parametrize(
    ("name", "zone"),
    [
        (f"@{EAST}@{NORTH}@32@T@@@@@@@@@@@.jpg", None),
        (f"@{EAST}@{NORTH}@32@T@@@@@@@@@@@.jpg", "33T"),
        (f"@{EAST}@{NORTH}@.jpg", "32T"),
        (f"@{EAST}@{NORTH}{NO_FIELDS}.jpg", "32t"),
    ],
)
def test_metres_lie_in_the_zone_of_the_name_or_else_in_the_given_one(
    name: str, zone: str | None
) -> None:
    fields = upload_fields_of_file_name(name, zone)
    assert float(fields["latitude"]) == pytest.approx(45.07, abs=1e-3)
    assert float(fields["longitude"]) == pytest.approx(7.69, abs=1e-3)
    assert "heading" not in fields


@pytest.mark.parametrize(
    ("name", "code", "named"),
    [
        (f"@{EAST}@{NORTH}{NO_FIELDS}.jpg", "no_utm_zone", "--utm-zone"),
        (f"@east@{NORTH}@32@T@.jpg", "bad_coordinates", "@east@"),
        (f"@{EAST}@{NORTH}@99@T@.jpg", "bad_coordinates", "@99@T@"),
        (f"@{EAST}@{NORTH}@32@I@.jpg", "bad_coordinates", "@32@I@"),
    ],
)
def test_a_name_without_a_place_on_earth_is_refused(name: str, code: str, named: str) -> None:
    with pytest.raises(InvalidRequest) as caught:
        upload_fields_of_file_name(name, None)
    assert caught.value.code == code
    assert named in caught.value.detail


@pytest.mark.parametrize("name", ["photo.jpg", "me@home.jpg", "a@1@2@3@4@.jpg", "@me.jpg"])
def test_ordinary_names_say_nothing(name: str) -> None:
    assert upload_fields_of_file_name(name, "32T") == {}


def stamped(timestamp: str) -> str:
    return f"@396877.76@4991561.25@32@T@45.0@7.0@@@@@@@{timestamp}@@.jpg"


@pytest.mark.parametrize(
    ("timestamp", "expected"),
    [
        ("20260501", "2026-05-01T00:00:00+00:00"),
        ("20260501093007", "2026-05-01T09:30:07+00:00"),
        ("20260501_093007", "2026-05-01T09:30:07+00:00"),
    ],
)
def test_full_date_becomes_the_time_of_capture(timestamp: str, expected: str) -> None:
    assert upload_fields_of_file_name(stamped(timestamp), None)["captured_at"] == expected


@pytest.mark.parametrize("timestamp", ["", "2019", "201905", "20191301", "2019050125", "yesterday"])
def test_shorter_or_impossible_timestamp_is_left_alone(timestamp: str) -> None:
    assert "captured_at" not in upload_fields_of_file_name(stamped(timestamp), None)


@pytest.mark.parametrize("name", ["@683466.04@7460686.99@23@S@.jpg", "@683466.04@7460686.99@.jpg"])
def test_a_northing_outside_the_band_is_an_error_that_names_both_readings(name: str) -> None:
    """23S, as people write it in Rio de Janeiro, is the band of 32 to 40 degrees north."""
    with pytest.raises(InvalidRequest) as caught:
        upload_fields_of_file_name(name, "23S")
    for text in ("band S (32 to 40 N)", "23K for 22.95 S", "23W for 67.21 N"):
        assert text in caught.value.detail
    found = upload_fields_of_file_name(name.replace("S", "K"), "23K")
    assert (found["latitude"], found["longitude"]) == ("-22.9519040", "-43.2106020")
