"""When a photo was taken, by its camera's clock and its GPS time.

Cameras write dates in more ways than EXIF allows: with blanks, dashes, fractions or a zone in them,
and hour 24 for the first hour of the same day, as Android's date format `kk` does.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

ZONE = r"Z|[+-]\s?\d{1,2}(?::?\d{2})?"
DATE = r"(\d{4})\s*[:/.-]\s*(\d{1,2})\s*[:/.-]\s*(\d{1,2})"
DATE_AND_TIME = re.compile(
    rf"{DATE}[T\s]\s*(\d{{1,2}})\s*:\s*(\d{{1,2}})(?:\s*:\s*(\d{{1,2}})?(?:[.,](\d+))?)?\s*({ZONE})?",
    re.IGNORECASE,
)
MAX_OFFSET = timedelta(hours=14)
# All zones of today: half hours, and those of Nepal, Eucla and Chatham.
ZONES = [timedelta(minutes=m) for m in (*range(-12 * 60, 14 * 60 + 1, 30), 345, 525, 765, 825)]
MAX_CLOCK_ERROR = timedelta(minutes=5)
"""of a clock whose zone follows from a GPS time"""
GPS_BEGIN = 1995  # the system was declared complete; earlier dates are those of a receiver's reset
ROLLOVER = timedelta(weeks=1024)  # of the week that satellites send
MAX_DIFFERENCE = timedelta(days=365)
"""Between a GPS time and a clock with its offset: one of both is wrong"""


@dataclass(frozen=True, slots=True)
class CaptureTime:
    """When a photo was taken."""

    captured_at: datetime | None = None
    """UTC; if `time_zone_is_known` is False, the camera's clock as if it were UTC"""
    time_zone_is_known: bool = False
    clock_offset: timedelta | None = None
    """of the camera's clock from UTC, if its tag or the GPS time says it"""


def read_time(sources: Sequence[Mapping[str, Any]]) -> CaptureTime:
    """Understand the tags of a photo's time; of several sources the first that has one counts.

    Args:
        sources: Tags by the names of EXIF; the GPSTimeStamp of XMP is text with the date.
    """
    clocks = (_clock(tags) for tags in sources)
    clock, offset = next((found for found in clocks if found[0]), (None, None))
    gps = next(filter(None, map(_gps_time, sources)), None)
    if gps is not None and clock is not None:
        gps = _put_right(gps, clock, offset)
    if gps is None or gps.year < GPS_BEGIN:
        if clock is None:
            return CaptureTime()
        try:
            return CaptureTime(clock - (offset or timedelta()), offset is not None, offset)
        except OverflowError:
            return CaptureTime()
    if clock is not None and offset is None:
        offset = zone_between(clock, gps)
    if clock is not None and offset is not None and not gps.microsecond and clock.microsecond:
        at = clock - offset
        if abs(at - gps) < timedelta(seconds=2):
            gps = at  # with the fractions that order the photos of a second
    return CaptureTime(gps, True, offset)


def zone_between(clock: datetime, utc: datetime) -> timedelta | None:
    """Return the zone of a clock by a time in UTC of the same moment; None if none fits."""
    zone = min(ZONES, key=lambda each: abs(clock - utc - each))
    return zone if abs(clock - utc - zone) <= MAX_CLOCK_ERROR else None


def parse_offset(text: str) -> timedelta | None:
    """Parse `+02:00`, `-5:00`, `+0530`, `+9` or `Z`; None for anything else."""
    text = "".join(text.strip("\0").split())
    if not re.fullmatch(ZONE, text, re.IGNORECASE):
        return None
    if text in "Zz":
        return timedelta()
    digits = text[1:].replace(":", "")
    hours, minutes = (digits[:-2], digits[-2:]) if len(digits) > 2 else (digits, "0")
    offset = timedelta(hours=int(hours), minutes=int(minutes))
    if offset > MAX_OFFSET or int(minutes) >= 60:
        return None
    return -offset if text[0] == "-" else offset


def parse_clock(text: str) -> tuple[datetime | None, timedelta | None]:
    """Parse a date with a time, and its zone, if it has one; the datetime has the zone UTC."""
    match = DATE_AND_TIME.fullmatch(text.strip("\0 "))
    if match is None:
        return None, None
    year, month, day, hour, minute = map(int, match.groups()[:5])
    microseconds = int((match[7] or "0").ljust(6, "0")[:6])
    try:
        clock = datetime(
            year,
            month,
            day,
            0 if hour == 24 else hour,
            minute,
            int(match[6] or 0),
            microseconds,
            UTC,
        )
    except ValueError:
        return None, None
    return clock, parse_offset(match[8]) if match[8] else None


def _clock(tags: Mapping[str, Any]) -> tuple[datetime | None, timedelta | None]:
    """Return the time that the camera's clock showed, with the zone UTC, and its offset."""
    for name in ("Original", "Digitized"):
        clock, offset = parse_clock(_text(tags.get(f"DateTime{name}")))
        if clock is None:
            continue
        fraction = _text(tags.get(f"SubsecTime{name}")).strip("\0 ")
        if fraction.isascii() and fraction.isdecimal() and not clock.microsecond:
            clock = clock.replace(microsecond=int(fraction.ljust(6, "0")[:6]))
        return clock, parse_offset(
            _text(tags.get(f"OffsetTime{name}"))
        ) if offset is None else offset
    return None, None


def _gps_time(tags: Mapping[str, Any]) -> datetime | None:
    """Return the GPS time, which is UTC."""
    day, clock = tags.get("GPSDateStamp"), tags.get("GPSTimeStamp")
    if isinstance(clock, str):
        time, _ = parse_clock(clock) if day is None else parse_clock(f"{_text(day)} {clock}")
        return time
    date = re.fullmatch(DATE, _text(day).strip("\0 "))
    if date is None or not isinstance(clock, tuple) or len(clock) != 3:
        return None
    try:
        hours, minutes, seconds = map(float, clock)
        if not (0 <= hours <= 24 and 0 <= minutes <= 60 and 0 <= seconds <= 61):
            return None
        midnight = datetime(int(date[1]), int(date[2]), int(date[3]), tzinfo=UTC)
        return midnight + timedelta(hours=hours % 24, minutes=minutes, seconds=seconds)
    except (TypeError, ValueError, OverflowError):
        return None


def _put_right(gps: datetime, clock: datetime, offset: timedelta | None) -> datetime | None:
    """Return the GPS time with the right week and day; None if it contradicts the clock.

    Some phones write the day of their clock, which is not that of UTC, beside the time of UTC.
    """
    try:
        at = clock - (offset or timedelta())
        for rollovers in (0, 1, 2, -1):
            if abs(gps + rollovers * ROLLOVER - at) <= timedelta(days=1):
                gps += rollovers * ROLLOVER
                moved = (gps + timedelta(days=days) for days in (0, 1, -1))
                fitting = ZONES if offset is None else [offset]
                return next((time for time in moved if zone_between(clock, time) in fitting), gps)
    except OverflowError:
        return None if offset is not None else gps
    is_set = offset is not None and clock.year >= GPS_BEGIN
    contradicts = is_set and abs(gps - at) > MAX_DIFFERENCE
    return None if contradicts else gps


def _text(value: Any) -> str:
    return value if isinstance(value, str) else ""
