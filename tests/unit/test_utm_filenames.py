"""Times in @UTM@ file names."""

from __future__ import annotations

import pytest

from shared.errors import InvalidRequest
from shared.utm_filenames import upload_fields_of_file_name


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
