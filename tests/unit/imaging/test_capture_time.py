"""Times of photos: the many ways in which cameras write dates, zones and GPS times."""

from __future__ import annotations

from datetime import timedelta
from typing import Any

import pytest

from shared.imaging.capture_time import CaptureTime, parse_offset, read_time


def taken(*sources: dict[str, Any]) -> str | None:
    time = read_time(sources).captured_at
    return None if time is None else time.isoformat().removesuffix("+00:00")


def clock(text: str, offset: str | None = None, fraction: str | None = None) -> dict[str, Any]:
    tags = {"DateTimeOriginal": text, "OffsetTimeOriginal": offset, "SubsecTimeOriginal": fraction}
    return {name: value for name, value in tags.items() if value is not None}


def gps(day: str, *time: float) -> dict[str, Any]:
    return {"GPSDateStamp": day, "GPSTimeStamp": tuple(map(float, time))}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("2024:05:01 10:00:00", "2024-05-01T10:00:00"),
        (" 2024:05: 1 10:00:00 \0", "2024-05-01T10:00:00"),
        ("2024:05:01  9:05:07", "2024-05-01T09:05:07"),
        ("2024-05-01T10:00:00", "2024-05-01T10:00:00"),
        ("2024-05-01 10:00:00.25", "2024-05-01T10:00:00.250000"),
        ("2024/05/01 10:00", "2024-05-01T10:00:00"),
        ("2024:05:01 10:00:00+02:00", "2024-05-01T08:00:00"),
        ("2024-05-01T10:00:00Z", "2024-05-01T10:00:00"),
        ("2019:01:01 24:04:20", "2019-01-01T00:04:20"),  # of Android's `kk`: of the same day
        ("    :  :     :  :  ", None),
        ("2024:05:01", None),
        ("2024:13:01 10:00:00", None),
    ],
)
def test_exif_dates_are_parsed(text: str, expected: str | None) -> None:
    assert taken(clock(text)) == expected


@pytest.mark.parametrize(
    ("text", "minutes"),
    [
        *(
            ("+02:00", 120),
            ("-5:00", -300),
            ("+0530", 330),
            ("+9", 540),
            ("Z", 0),
            ("- 5:00", -300),
        ),
        *(("   :  ", None), ("", None), ("+99:00", None), ("+02:75", None), ("Europe/Paris", None)),
    ],
)
def test_a_blank_or_invalid_utc_offset_is_ignored(text: str, minutes: int | None) -> None:
    offset = None if minutes is None else timedelta(minutes=minutes)
    assert parse_offset(text) == offset
    found = read_time([clock("2024:05:01 10:00:00", text)])
    assert found.time_zone_is_known == (minutes is not None)
    assert found.captured_at is not None


def test_fractions_are_kept_also_beside_a_gps_time_of_whole_seconds() -> None:
    assert taken(clock("2024:05:01 10:00:00", "+02:00", "05")) == "2024-05-01T08:00:00.050000"
    near = gps("2024:05:01", 8, 0, 1) | clock("2024:05:01 10:00:00", None, "9")
    assert taken(near) == "2024-05-01T08:00:00.900000"
    assert taken(near | {"GPSTimeStamp": (8.0, 0.0, 30.0)}) == "2024-05-01T08:00:30"


def test_the_time_of_digitising_stands_in_for_a_missing_original() -> None:
    digitized = {
        "DateTimeDigitized": "2024:05:01 10:00:00",
        "OffsetTimeDigitized": "+02:00",
        "SubsecTimeDigitized": "5",
    }
    assert taken(digitized) == "2024-05-01T08:00:00.500000"
    assert taken(clock("    :  :     :  :  ") | digitized) == "2024-05-01T08:00:00.500000"
    assert taken(clock("2024:05:01 09:00:00") | digitized) == "2024-05-01T09:00:00"
    assert taken({}, {"DateTimeOriginal": "2024-05-01T10:00:00+02:00"}) == "2024-05-01T08:00:00"


@pytest.mark.parametrize(
    ("of_gps", "of_clock", "expected"),
    [
        (
            gps("1970:01:18", 19, 5, 52),
            clock("2018:09:21 18:49:01", "+01:00"),
            "2018-09-21T17:49:01",
        ),
        (gps("1970:01:18", 19, 5, 52), clock("2018:09:21 18:49:01"), "2018-09-21T18:49:01"),
        (gps("0000:00:00", 0, 0, 0), clock("2018:09:21 18:49:01", "+01:00"), "2018-09-21T17:49:01"),
        (gps("2012:03:04", 1, 2, 3), clock("2018:09:21 18:49:01", "+01:00"), "2018-09-21T17:49:01"),
        (gps("2012:03:04", 1, 2, 3), clock("2018:09:21 18:49:01"), "2012-03-04T01:02:03"),
        (
            gps("2018:09:21", 17, 49, 9),
            clock("1980:01:01 00:00:00", "+01:00"),
            "2018-09-21T17:49:09",
        ),
        # 1,024 weeks before 21 September 2018, and after it
        (gps("1999:02:05", 17, 49, 3), clock("2018:09:21 18:49:01"), "2018-09-21T17:49:03"),
        (gps("1979:06:22", 17, 49, 3), clock("2018:09:21 18:49:01"), "2018-09-21T17:49:03"),
        (
            gps("2038:05:07", 17, 49, 3),
            clock("2018:09:21 18:49:01", "+01:00"),
            "2018-09-21T17:49:03",
        ),
        (gps("1970:01:18", 19, 5, 52), {}, None),
    ],
)
def test_a_gps_date_that_contradicts_the_camera_clock_is_ignored(
    of_gps: dict[str, Any], of_clock: dict[str, Any], expected: str | None
) -> None:
    assert taken(of_gps | of_clock) == expected


@pytest.mark.parametrize(
    ("of_clock", "hours", "expected"),
    [
        (clock("2023:05:02 00:30:00", "+02:00"), 22, "2023-05-01T22:30:00"),
        (clock("2023:05:02 00:30:00"), 22, "2023-05-01T22:30:00"),
        (clock("2023:05:02 20:30:00", "-07:00"), 3, "2023-05-03T03:30:00"),
        (clock("2023:05:02 20:30:00"), 3, "2023-05-03T03:30:00"),
        (clock("2023:05:02 00:30:00", "+13:00"), 11, "2023-05-01T11:30:00"),  # not -11:00
        (clock("2023:05:02 23:30:00", "+00:00"), 23, "2023-05-02T23:30:00"),
        (clock("2023:05:02 20:30:00", "-01:00"), 3, "2023-05-02T03:30:00"),  # another zone's
    ],
)
def test_the_day_of_a_gps_time_is_put_right_where_it_is_that_of_the_clock(
    of_clock: dict[str, Any], hours: int, expected: str
) -> None:
    assert taken(gps("2023:05:02", hours, 30, 0) | of_clock) == expected


def test_the_zone_of_a_clock_follows_from_the_gps_time() -> None:
    found = read_time([gps("2024:05:01", 4, 29, 58) | clock("2024:05:01 10:00:01")])
    assert found.clock_offset == timedelta(hours=5, minutes=30)
    far = read_time([gps("2024:05:01", 4, 10, 0) | clock("2024:05:01 10:00:01")])
    assert (far.time_zone_is_known, far.clock_offset) == (True, None)
    assert read_time([]) == CaptureTime()
