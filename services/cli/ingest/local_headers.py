"""Headers of photos on this machine, with their sidecars and time zones."""

from __future__ import annotations

import contextlib
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from datetime import UTC, datetime, timezone, tzinfo
from pathlib import Path
from typing import BinaryIO
from zoneinfo import ZoneInfo

from shared.errors import InvalidRequest, PlacewiseError
from shared.geotagging.evidence import Dated, DatedPhoto
from shared.imaging.bounded_reader import MAX_METADATA_BYTES
from shared.imaging.photo_header import PhotoHeader, read_photo_header

TAKEOUT_NAME_CHARACTERS = 46  # to which Google Takeout cuts the name of a JSON off


def find_sidecars(photo: Path) -> list[Path]:
    """Return the sidecars of a photo that exist: `IMG_1.jpg.xmp`, `IMG_1.xmp`, then JSON."""
    xmp = (name + suffix for name in (photo.name, photo.stem) for suffix in (".xmp", ".XMP"))
    paths = map(photo.with_name, (*xmp, *_takeout_names(photo)))
    return [path for path in paths if os.path.isfile(path)]  # noqa: PTH113 any length


def _takeout_names(photo: Path) -> Iterator[str]:
    """Yield what Google Takeout may have named the JSON of a photo.

    It is `IMG_1.jpg.supplemental-metadata.json`, before 2024 `IMG_1.jpg.json`; that of
    `IMG_1(1).jpg` has the number before `.json`.
    """
    copy = re.fullmatch(r"(.+)(\(\d+\))", photo.stem)
    for name, number in ((photo.name, ""), *([(copy[1] + photo.suffix, copy[2])] if copy else [])):
        for kept in (f"{name}.supplemental-metadata", name):
            yield f"{kept[:TAKEOUT_NAME_CHARACTERS]}{number}.json"


def read_sidecar(path: Path) -> bytes:
    """Return a sidecar; one that is too large or can't be read is cut off, and not understood."""
    with contextlib.suppress(OSError), path.open("rb") as file:
        return file.read(MAX_METADATA_BYTES)
    return b""


def read_local_header(file: BinaryIO, sidecars: Iterable[bytes] = ()) -> PhotoHeader:
    """Read the header of a photo of any size; one without values if it can't be read.

    The server, or the search of the map, names what is wrong with such a photo.
    """
    with contextlib.suppress(PlacewiseError):
        return read_photo_header(file, sys.maxsize, tuple(sidecars))
    return PhotoHeader(0, 0)


def dated_photo(name: str, header: PhotoHeader) -> DatedPhoto:
    """Return what a header says about when and where a photo was taken."""
    return DatedPhoto(
        name,
        header.captured_at,
        header.time_zone_is_known,
        header.camera,
        header.latitude,
        header.longitude,
        header.clock_offset,
        header.camera_is_unique,
    )


def move_time(time: datetime | None, change: Callable[[datetime], datetime]) -> datetime | None:
    """Change a time; None if it was no date, such as 0001-01-01, which can't be moved."""
    try:
        return None if time is None else change(time)
    except OverflowError:
        return None


def parse_time_zone(text: str) -> tzinfo:
    """Parse an offset such as `+02:00`, `UTC` or a name of the time zone database."""
    with contextlib.suppress(ValueError):
        offset = datetime.fromisoformat(f"2000-01-01T00:00:00{text}").utcoffset()
        if offset is not None:
            return timezone(offset)
    try:
        return ZoneInfo(text)
    except (ValueError, LookupError, OSError) as error:
        raise InvalidRequest(
            "bad_time_zone",
            f"{text!r} is no time zone. Write an offset such as +02:00, or a name such as "
            "Europe/Paris.",
        ) from error


def in_time_zone(photo: Dated, zone: tzinfo) -> Dated:
    """Return the photo with the time in UTC that its clock showed in a zone, unless it is known."""
    if photo.time is None or photo.time_zone_is_known:
        return photo
    time = move_time(photo.time, lambda clock: clock.replace(tzinfo=zone).astimezone(UTC))
    return replace(photo, time=time, time_zone_is_known=time is not None)
